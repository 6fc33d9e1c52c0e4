"""Calibrated cameras, turned ones too, and the exact geometry of two of them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.robust import Matrix3

QUARTER: Matrix3 = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""A quarter turn, counter-clockwise as one looks at the picture: (x, y) goes to (y, -x), y being down."""
QUARTER.setflags(write=False)


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: K (3, 3) in pixels; R (3, 3) and t (3,) take world to camera, X_cam = R X + t."""

    K: Matrix3
    R: Matrix3
    t: NDArray[np.float64]

    @property
    def calibrated(self) -> "Camera":
        """The same camera with rays for pixels: the F of two such is the E of the two."""
        return replace(self, K=np.eye(3))

    def turned(self, quarters: int, size: Size) -> "Camera":
        """The camera that takes ``np.rot90(picture, quarters)``, where this one takes a picture of ``size``.

        A quarter turn moves the pixel (x, y) to (y, width - 1 - x). The camera turns about its axis by as much,
        so that K stays what K is, with its focal lengths and its centre changing places.
        """
        camera, (width, height) = self, size
        for _ in range(quarters % 4):
            moved = np.array([[1.0, 0, 0], [0, 1, width - 1], [0, 0, 1]]) @ QUARTER
            camera = Camera(moved @ camera.K @ QUARTER.T, QUARTER @ camera.R, QUARTER @ camera.t)
            width, height = height, width
        return camera


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
