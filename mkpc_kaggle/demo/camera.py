"""Pinhole cameras with image sizes: projection of world points, and covisibility of two views.

Pixel centres are at integer coordinates: (0, 0) is the centre of the top-left pixel, x to the
right, y down. The world has z up; a camera looks along its +z. `X_cam = R X + t`.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.geometry.cameras import Camera

Floats = NDArray[np.float64]
FloatImage = NDArray[np.float32]

DEPTH_TOLERANCE = 0.01  # relative; on a plane, interpolating inverse depth is exact
STEP_PX = 3  # covisibility needs only every third pixel of every third row


@dataclass(frozen=True, eq=False)
class SizedCamera(Camera):
    """A camera with its image's width and height in pixels; t in metres."""

    width: int
    height: int


def look_at(
    position: ArrayLike, target: ArrayLike, focal: float, size: tuple[int, int], roll: float = 0.0
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
    offset = (scale - 1) / 2  # (x + 0.5) s - 0.5 = s x + (s - 1) / 2
    to_resized = np.array([[scale, 0, offset], [0, scale, offset], [0, 0, 1]])
    width = max(1, round(camera.width * scale))
    height = max(1, round(camera.height * scale))
    return replace(camera, K=to_resized @ camera.K, width=width, height=height)


def project(camera: SizedCamera, points: Floats) -> tuple[Floats, Floats]:
    """Project world points (N, 3) to pixels (N, 2) and depths (N,).

    Pixels of depth <= 0 are undefined.
    """
    in_camera = points @ camera.R.T + camera.t
    image = in_camera @ camera.K.T
    depth = image[:, 2]
    # No division by zero: NumPy would warn, and callers ignore these pixels.
    divisor = np.where(depth == 0, np.finfo(np.float64).tiny, depth)
    return image[:, :2] / divisor[:, None], depth


def unproject(camera: SizedCamera, pixels: Floats, depth: Floats) -> Floats:
    """Convert pixels (N, 2), with depths (N,) along the camera's axis, to world points (N, 3)."""
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    rays = homogeneous @ np.linalg.inv(camera.K).T  # of depth 1
    in_camera = rays * depth[:, None]
    # R is orthogonal, so the product with R instead of R^T undoes the rotation of rows.
    return np.asarray((in_camera - camera.t) @ camera.R, dtype=np.float64)


def visible_mask(
    first: SizedCamera,
    first_depth: FloatImage,
    second: SizedCamera,
    second_depth: FloatImage,
    step: int = 1,
) -> NDArray[np.bool_]:
    """Return where `second` shows the same points, a bool mask of every `step`-th pixel of `first`.

    Depths are (H, W) float32 in metres, and inf for the sky, which is never shared. A point is not
    visible outside the second image, behind the second camera, or behind a nearer surface.
    """
    y, x = np.mgrid[0 : first.height : step, 0 : first.width : step]
    depth = first_depth[::step, ::step].astype(np.float64)
    is_surface = np.isfinite(depth)
    # Any finite depth will do for the sky, which is_surface excludes.
    finite_depth = np.where(is_surface, depth, 1.0).ravel()
    sampled = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    pixels, expected = project(second, unproject(first, sampled, finite_depth))

    last_pixel = (second.width - 1, second.height - 1)
    inside = ((pixels >= 0) & (pixels <= last_pixel)).all(axis=1)
    inside &= expected > 0

    # On a plane, 1 / depth is linear in the pixel, so bilinear interpolation is exact.
    # Any pixel will do for points outside, which ``inside`` excludes.
    read = np.where(inside[:, None], pixels, 0)
    maps = read.astype(np.float32).reshape(*x.shape, 2)
    nearness = 1 / second_depth
    found = cv2.remap(nearness, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    agrees = np.abs(found * expected.reshape(x.shape) - 1) < DEPTH_TOLERANCE
    return np.asarray(is_surface & inside.reshape(x.shape) & agrees, dtype=np.bool_)


def covisibility(
    first: SizedCamera, first_depth: FloatImage, second: SizedCamera, second_depth: FloatImage
) -> float:
    """Return the smaller fraction of one view visible in the other, in [0, 1], in any order."""
    shared_by_first = visible_mask(first, first_depth, second, second_depth, STEP_PX)
    shared_by_second = visible_mask(second, second_depth, first, first_depth, STEP_PX)
    return min(float(shared_by_first.mean()), float(shared_by_second.mean()))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
