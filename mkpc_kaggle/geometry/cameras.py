"""Calibrated cameras, and the exact two-view geometry of two cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.two_view import cross_matrix

MIN_BASELINE = 1e-9  # world units; two closer cameras count as one point


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: K (3, 3) in pixels; R (3, 3) and t (3,) map world to camera, X_cam = R X + t."""

    K: Matrix3
    R: Matrix3
    t: NDArray[np.float64]

    @property
    def calibrated(self) -> "Camera":
        """The same camera with K the identity. F of two calibrated cameras is their E."""
        return replace(self, K=np.eye(3))


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix3, NDArray[np.float64]]:
    """Return R (3, 3) and t (3,) with X_1 = R X_0 + t, in world units."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental_of_cameras(camera0: Camera, camera1: Camera) -> Matrix3:
    """Return F with x1^T F x0 = 0 and unit Frobenius norm: K1^-T [t]_x R K0^-1.

    Raises ``ValueError`` if the two cameras have the same centre: F is not defined.
    """
    R, t = relative_pose(camera0, camera1)
    if np.linalg.norm(t) < MIN_BASELINE * max(1.0, float(np.linalg.norm(camera0.t))):
        raise ValueError("the two cameras have one centre: F is not defined")
    F = np.linalg.inv(camera1.K).T @ cross_matrix(t) @ R @ np.linalg.inv(camera0.K)
    return np.asarray(F / np.linalg.norm(F))


def mean_cameras(pairs: Sequence[tuple[Camera, Camera]], max_degrees: float) -> tuple[Camera, Camera]:
    """Return two cameras with the mean relative pose and focal lengths of several estimates.

    Each estimate has its own world. Estimates with a relative rotation more than ``max_degrees`` from the first
    are ignored. Translation directions are averaged as unit vectors, focal lengths geometrically. The principal
    points are the first estimate's. Raises ``ValueError`` if the two cameras of an estimate have the same centre.
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
