"""The similarity between two models of the same images, for errors of cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Matrix3

MIN_COMMON = 3  # cameras
OUTLIER = 4.0  # times the median distance: a camera that the two reconstructions place differently


@dataclass(frozen=True, eq=False)
class Similarity:
    """X_new = scale * R X_old + t."""

    scale: float
    R: Matrix3
    t: NDArray[np.float64]

    def of_points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (N, 3) in the new world."""
        return np.asarray(self.scale * points @ self.R.T + self.t)

    def of_camera(self, camera: Camera) -> Camera:
        R = camera.R @ self.R.T
        centre = self.of_points(camera.centre[None])[0]
        return Camera(camera.K, R, -R @ centre)


def find_similarity(cameras: Sequence[Camera], targets: Sequence[Camera]) -> Similarity | None:
    """Return the similarity that moves cameras onto their targets; ``None`` without ``MIN_COMMON``
    usable pairs.

    Rotations determine the rotation, so centres on a line are enough. Medians give a first
    estimate, then least squares without the cameras that are far from their targets.
    """
    if len(cameras) < MIN_COMMON:
        return None
    turns = []
    for camera, target in zip(cameras, targets, strict=True):
        turns.append(target.R.T @ camera.R)
    R = _mean_rotation(turns)
    # From here on, only scale and offset are unknown.
    centres = _centres(cameras) @ R.T
    goals = _centres(targets)
    scale = _median_scale(centres, goals)
    if scale is None:
        return None
    # Medians tolerate cameras that the two reconstructions place differently.
    offset = np.median(goals - scale * centres, axis=0)
    missed = scale * centres + offset - goals
    distances = np.linalg.norm(missed, axis=1)
    near = distances <= OUTLIER * np.median(distances)
    if near.sum() < MIN_COMMON:  # of three cameras, none can be called wrong
        near[:] = True
    return _least_squares(R, centres[near], goals[near])


def model_size(cameras: Sequence[Camera]) -> float:
    """Return the size of a model: the RMS distance of its cameras from their mean."""
    return float(np.sqrt(_centres(cameras).var(axis=0).sum()))


def _mean_rotation(rotations: Sequence[Matrix3]) -> Matrix3:
    """Return the rotation nearest to the mean."""
    U, _, Vt = np.linalg.svd(np.sum(rotations, axis=0))
    # Without the determinant it could be a reflection.
    signs = np.diag([1, 1, np.linalg.det(U @ Vt)])
    return np.asarray(U @ signs @ Vt)


def _median_scale(centres: NDArray[np.float64], goals: NDArray[np.float64]) -> float | None:
    """Return the median ratio of distances between goals and between centres; ``None`` for a single
    centre.
    """
    # Distances do not depend on the offset, which comes later.
    before = pdist(centres)
    after = pdist(goals)
    apart = before > 0
    return float(np.median(after[apart] / before[apart])) if apart.any() else None


def _least_squares(
    R: Matrix3, centres: NDArray[np.float64], goals: NDArray[np.float64]
) -> Similarity | None:
    """Return the similarity with rotation ``R`` that moves the rotated centres (N, 3) to their
    goals.
    """
    centre = centres.mean(axis=0)
    goal = goals.mean(axis=0)
    spread = centres - centre
    variance = float((spread**2).sum())
    if variance == 0:
        return None
    covariance = float((spread * (goals - goal)).sum())
    scale = covariance / variance
    # A scale that is not positive would turn the model inside out.
    return Similarity(scale, R, goal - scale * centre) if scale > 0 else None


def _centres(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    return np.array([camera.centre for camera in cameras]).reshape(-1, 3)
