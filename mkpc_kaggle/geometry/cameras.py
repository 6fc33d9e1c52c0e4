"""Calibrated cameras and the exact geometry of two of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.two_view import cross_matrix

MIN_BASELINE = 1e-9  # below it, in units of the world, two cameras stand at the same point


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: K (3, 3) in pixels; R (3, 3) and t (3,) take world to camera, X_cam = R X + t."""

    K: Matrix3
    R: Matrix3
    t: NDArray[np.float64]

    @property
    def calibrated(self) -> "Camera":
        """The same camera with K the identity: F of two such cameras is E of the two."""
        return replace(self, K=np.eye(3))


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix3, NDArray[np.float64]]:
    """R (3, 3) and t (3,) with X_1 = R X_0 + t, in the cameras' world units."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental_of_cameras(camera0: Camera, camera1: Camera) -> Matrix3:
    """The true F, x1^T F x0 = 0, of unit Frobenius norm: K1^-T [t]_x R K0^-1.

    Raises ``ValueError`` when the two cameras stand at the same point: then F is not defined.
    """
    R, t = relative_pose(camera0, camera1)
    if np.linalg.norm(t) < MIN_BASELINE * max(1.0, float(np.linalg.norm(camera0.t))):
        raise ValueError("the two cameras have one centre: F is not defined")
    F = np.linalg.inv(camera1.K).T @ cross_matrix(t) @ R @ np.linalg.inv(camera0.K)
    return np.asarray(F / np.linalg.norm(F))


def mean_cameras(pairs: Sequence[tuple[Camera, Camera]], max_degrees: float) -> tuple[Camera, Camera]:
    """Two cameras whose relative pose and focal lengths are the mean of several answers for the same two cameras.

    Each answer has a world of its own. An answer whose relative rotation is more than ``max_degrees`` from that of
    the first is left out. The directions of translation are averaged as unit vectors, focal lengths geometrically;
    principal points are those of the first. Raises ``ValueError`` if the cameras of an answer have one centre.
    """
    poses = [relative_pose(*pair) for pair in pairs]
    rotations = Rotation.from_matrix(np.stack([R for R, _ in poses]))
    near = np.degrees((rotations * rotations[0].inv()).magnitude()) <= max_degrees
    kept = np.flatnonzero(near).tolist()
    direction = np.sum([_unit(poses[index][1]) for index in kept], axis=0)
    K0, K1 = (_mean_intrinsics([pairs[index][side].K for index in kept]) for side in (0, 1))
    return Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, rotations[near].mean().as_matrix(), _unit(direction))


def _unit(t: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(t))
    if length < MIN_BASELINE:
        raise ValueError("the two cameras have one centre")
    return t / length


def _mean_intrinsics(matrices: Sequence[Matrix3]) -> Matrix3:
    mean = matrices[0].copy()
    for axis in (0, 1):
        mean[axis, axis] = np.exp(np.mean([np.log(K[axis, axis]) for K in matrices]))
    return mean
