"""Calibrated cameras, and the exact two-view geometry of two cameras."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.two_view import cross_matrix

MIN_BASELINE = 1e-9  # world units; closer cameras have the same centre


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    K (3, 3) is in pixels. R (3, 3) and t (3,) map world to camera: X_cam = R X + t.
    """

    K: Matrix3
    R: Matrix3
    t: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Position in the world, (3,)."""
        return -self.R.T @ self.t


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix3, NDArray[np.float64]]:
    """Return R (3, 3) and t (3,) with X_1 = R X_0 + t, in world units."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental_of_cameras(camera0: Camera, camera1: Camera) -> Matrix3:
    """Return F = K1^-T [t]_x R K0^-1, scaled to unit Frobenius norm, with x1^T F x0 = 0.

    Raises ``ValueError`` if the two cameras have the same centre, since F is then undefined.
    """
    R, t = relative_pose(camera0, camera1)
    # Far from the origin, t is a difference of large numbers and only as precise as these.
    size = max(1.0, float(np.linalg.norm(camera0.t)))
    if np.linalg.norm(t) < MIN_BASELINE * size:
        raise ValueError("the two cameras have one centre: F is not defined")
    # Hartley and Zisserman, Multiple View Geometry, 9.6: E = [t]x R.
    to_ray0 = np.linalg.inv(camera0.K)
    to_ray1 = np.linalg.inv(camera1.K)
    F = to_ray1.T @ cross_matrix(t) @ R @ to_ray0
    return np.asarray(F / np.linalg.norm(F))
