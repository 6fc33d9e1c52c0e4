"""Pinhole cameras with image sizes, and projection between world points and pixels.

Pixel centres are at integer coordinates: (0, 0) is the centre of the top-left pixel, x to the right, y down.
The world has z up; a camera looks along its +z. `X_cam = R X + t`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.geometry.cameras import Camera

Floats = NDArray[np.float64]
FloatImage = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SizedCamera(Camera):
    """A camera with its image's width and height in pixels; t in world units."""

    width: int
    height: int

    @property
    def centre(self) -> Floats:
        """The position in the world, (3,)."""
        return np.asarray(-self.R.T @ self.t, dtype=np.float64)


def look_at(
    position: ArrayLike, target: ArrayLike, focal: float, size: tuple[int, int], roll: float = 0.0
) -> SizedCamera:
    """Return a camera at `position` with `target` in the middle of its image of `size`, (width, height).

    `focal` is in pixels; `roll` turns the camera clockwise about its axis, in degrees. Position and target
    are (3,) world points, one not above the other.
    """
    centre = np.asarray(position, dtype=np.float64)
    forward = _unit(np.asarray(target, dtype=np.float64) - centre)
    right = _unit(np.cross(forward, (0.0, 0.0, 1.0)))
    down = np.cross(forward, right)
    cos, sin = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    R = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]], dtype=np.float64)
    return SizedCamera(K, R, -R @ centre, *size)


def resized(camera: SizedCamera, scale: float) -> SizedCamera:
    """Return the camera of the image resized by `scale`: `x' = (x + 0.5) * scale - 0.5`.

    Sides are rounded to whole pixels and K keeps the exact scale. So the image loses or gains up to half a pixel
    on the right and at the bottom.
    """
    to_resized = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
    width, height = (max(1, round(side * scale)) for side in (camera.width, camera.height))
    return replace(camera, K=to_resized @ camera.K, width=width, height=height)


def project(camera: SizedCamera, points: Floats) -> tuple[Floats, Floats]:
    """Project world points (N, 3) to pixels (N, 2) and depths (N,); pixels are undefined where depth <= 0."""
    image = (points @ camera.R.T + camera.t) @ camera.K.T
    depth = image[:, 2]
    return image[:, :2] / np.where(depth == 0, np.finfo(np.float64).tiny, depth)[:, None], depth


def unproject(camera: SizedCamera, pixels: Floats, depth: Floats) -> Floats:
    """Convert pixels (N, 2) and depths (N,) along the camera's axis to world points (N, 3)."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
    return np.asarray((rays * depth[:, None] - camera.t) @ camera.R, dtype=np.float64)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
