"""Pinhole cameras with image sizes, and covisibility of two views.

Pixel centres are at integer coordinates: (0, 0) is the centre of the top-left pixel, x to the
right, y down. The world has z up; a camera looks along its +z. `X_cam = R X + t`.

Nearness is the inverse of the depth along the camera's axis, in 1 / metres. It is 0 for the sky,
and on a plane it is linear in the pixel.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.geometry.cameras import Camera, relative_pose

Floats = NDArray[np.float64]
FloatImage = NDArray[np.float32]

TOLERANCE = 0.01  # relative, of nearness
STEP_PX = 3  # covisibility needs only every third pixel of every third row


@dataclass(frozen=True, eq=False)
class SizedCamera(Camera):
    """A camera with its image's width and height in pixels; t in metres."""

    width: int
    height: int


def look_at(
    position: ArrayLike,
    target: ArrayLike,
    focal: float,
    size: tuple[int, int],
    roll: float = 0.0,
) -> SizedCamera:
    """Return a camera at `position` that has `target` at the centre of its image.

    `size` is (width, height) and `focal` the focal length, in pixels. `roll`, in degrees, turns the
    camera clockwise about its axis. Position and target are world points (3,), neither above the
    other.
    """
    centre = np.asarray(position, dtype=np.float64)
    forward = _unit(np.asarray(target, dtype=np.float64) - centre)
    # Perpendicular to the world's vertical: without roll the horizon is level.
    right = _unit(np.cross(forward, (0.0, 0.0, 1.0)))
    down = np.cross(forward, right)
    cos = np.cos(np.radians(roll))
    sin = np.sin(np.radians(roll))
    # The rows of R are the camera's axes in the world.
    R = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    K = np.diag([focal, focal, 1.0])
    # Pixel centres are at integers, so the middle of n pixels is at (n - 1) / 2.
    K[:2, 2] = (np.array(size) - 1) / 2
    return SizedCamera(K, R, -R @ centre, *size)


def resized_camera(camera: SizedCamera, scale: float) -> SizedCamera:
    """Return the camera of the image resized by `scale`: `x' = (x + 0.5) * scale - 0.5`.

    Sides are rounded to whole pixels, but K has the exact scale. So the image loses or gains up to
    half a pixel on the right and at the bottom.
    """
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += (scale - 1) / 2  # (x + 0.5) s - 0.5 = s x + (s - 1) / 2
    width = max(1, round(camera.width * scale))
    height = max(1, round(camera.height * scale))
    return replace(camera, K=K, width=width, height=height)


def transfer(
    first: SizedCamera, nearness: FloatImage, second: SizedCamera
) -> tuple[Floats, Floats]:
    """Return where `second` would show the points of `first`, if nothing were in front of them.

    `nearness` (H, W) belongs to `first`. The results are pixels (h, w, 2) in `second` and their
    nearness (h, w) there, for every third pixel of every third row. Behind `second` it is negative.
    """
    R, t = relative_pose(first, second)
    y, x = np.mgrid[0 : first.height : STEP_PX, 0 : first.width : STEP_PX]
    near = nearness[::STEP_PX, ::STEP_PX].astype(np.float64)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = pixels @ np.linalg.inv(first.K).T
    # The point's coordinates times its nearness: a direction for the sky.
    in_second = rays @ R.T + near[..., None] * t
    image = in_second @ second.K.T
    scale = image[..., 2]
    return image[..., :2] / scale[..., None], near / scale


def visible_mask(
    first: SizedCamera,
    first_nearness: FloatImage,
    second: SizedCamera,
    second_nearness: FloatImage,
) -> NDArray[np.bool_]:
    """Return where `second` shows the same points, for the pixels of `transfer`: bool (h, w).

    The sky is never shared. A point is not visible outside the second image, behind the second
    camera, or behind a nearer surface.
    """
    pixels, expected = transfer(first, first_nearness, second)
    x, y = np.moveaxis(pixels.astype(np.float32), -1, 0)
    # Outside the image OpenCV returns 0, the nearness of the sky, which agrees with no point.
    found = cv2.remap(second_nearness, x, y, cv2.INTER_LINEAR)
    return np.asarray(np.abs(found - expected) < TOLERANCE * expected)


def covisibility(
    first: SizedCamera,
    first_nearness: FloatImage,
    second: SizedCamera,
    second_nearness: FloatImage,
) -> float:
    """Return the smaller fraction of one view visible in the other, in [0, 1], in any order."""
    shared_by_first = visible_mask(first, first_nearness, second, second_nearness)
    shared_by_second = visible_mask(second, second_nearness, first, first_nearness)
    return min(float(shared_by_first.mean()), float(shared_by_second.mean()))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
