"""Covisibility of two views from exact depth."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.demo.camera import FloatImage, SizedCamera, project, unproject

DEPTH_TOLERANCE = 0.01  # relative; interpolated inverse depth is exact on a plane
STEP_PX = 3  # every third pixel of every third row suffices


def visible_mask(
    first: SizedCamera, first_depth: FloatImage, second: SizedCamera, second_depth: FloatImage, step: int = 1
) -> NDArray[np.bool_]:
    """Return a bool mask of every `step`-th pixel of `first`: True if `second` shows the same point.

    The depths are (H, W) float32 in world units, inf for the sky, which is never shared. A point is not visible
    outside the second image, behind its camera, or behind a nearer surface.
    """
    y, x = np.mgrid[0 : first.height : step, 0 : first.width : step]
    depth = first_depth[::step, ::step].astype(np.float64)
    is_surface = np.isfinite(depth)
    corners = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    pixels, expected = project(second, unproject(first, corners, np.where(is_surface, depth, 1.0).ravel()))
    inside = (pixels >= 0).all(axis=1) & (pixels <= (second.width - 1, second.height - 1)).all(axis=1)
    inside &= expected > 0
    maps = np.where(inside[:, None], pixels, 0).astype(np.float32).reshape(*x.shape, 2)
    found = cv2.remap(np.float32(1) / second_depth, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    agrees = np.abs(found * expected.reshape(x.shape) - 1) < DEPTH_TOLERANCE
    return np.asarray(is_surface & inside.reshape(x.shape) & agrees, dtype=np.bool_)


def covisibility(
    first: SizedCamera, first_depth: FloatImage, second: SizedCamera, second_depth: FloatImage
) -> float:
    """Return the smaller of the shares of either view visible in the other: symmetric, in [0, 1]."""
    ways = ((first, first_depth, second, second_depth), (second, second_depth, first, first_depth))
    return min(float(visible_mask(*way, STEP_PX).mean()) for way in ways)
