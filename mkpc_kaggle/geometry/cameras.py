"""Calibrated cameras and the exact geometry of two of them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.two_view import cross_matrix

# A quarter turn of a picture, counter-clockwise: (x, y) goes to (y, -x), y being down.
QUARTER: Matrix3 = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
QUARTER.setflags(write=False)
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

    def rotated_90(self, times: int, size: Size) -> "Camera":
        """The camera that takes ``np.rot90(picture, times)`` where this camera takes a picture of ``size``.

        A quarter turn moves the pixel (x, y) to (y, width - 1 - x). The camera turns about its axis, so that in K
        focal lengths and the centre's coordinates only change places.
        """
        camera, (width, height) = self, size
        for _ in range(times % 4):
            moved = np.array([[1.0, 0, 0], [0, 1, width - 1], [0, 0, 1]]) @ QUARTER
            camera = Camera(moved @ camera.K @ QUARTER.T, QUARTER @ camera.R, QUARTER @ camera.t)
            width, height = height, width
        return camera


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
