"""Calibrated cameras, and the exact geometry of two of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.robust import Matrix3


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: K (3, 3) in pixels; R (3, 3) and t (3,) take world to camera, X_cam = R X + t."""

    K: Matrix3
    R: Matrix3
    t: NDArray[np.float64]


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix3, NDArray[np.float64]]:
    """R (3, 3) and t (3,) with X_1 = R X_0 + t, in the cameras' world units."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental_of_cameras(camera0: Camera, camera1: Camera) -> Matrix3:
    """The true F with x1^T F x0 = 0 and unit Frobenius norm: K1^-T [t]_x R K0^-1.

    Raises ``ValueError`` when the two cameras stand at the same point: there is no F then.
    """
    R, t = relative_pose(camera0, camera1)
    if np.linalg.norm(t) < 1e-9 * max(1.0, float(np.linalg.norm(camera0.t))):
        raise ValueError("the two cameras have one centre: F is not defined")
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(camera1.K).T @ cross @ R @ np.linalg.inv(camera0.K)
    return np.asarray(F / np.linalg.norm(F))
