"""Colours of a model's points, from the pixels that see them.

pycolmap has the same, but decodes neither WebP nor AVIF.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX, Pixels

DECODERS = 4  # threads, and decoded images at a time


def colour_points(model: Any, folder: Path) -> None:
    """Give each point of pycolmap's model the mean colour of the pixels that see it.

    An image that cannot be read counts for no point. A point without a colour stays black.
    """
    images = list(model.images.values())

    def seen_by(number: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        image = images[number]
        observed = [point for point in image.points2D if point.has_point3D()]
        picture = read_image(folder / image.name)
        if not observed or not isinstance(picture, Image):
            return np.empty(0, np.int64), np.empty((0, 3))
        points = np.array([point.xy for point in observed]) - COLMAP_CENTRE_PX
        numbers = np.array([point.point3D_id for point in observed], np.int64)
        return numbers, colours_at(picture.pixels, points)

    # Decoding takes nearly all the time, and OpenCV decodes without the interpreter's lock.
    with ThreadPoolExecutor(DECODERS) as pool:
        parts = list(pool.map(seen_by, range(len(images))))
    numbers = np.concatenate([part[0] for part in parts])
    colours = np.concatenate([part[1] for part in parts])
    points, at = np.unique(numbers, return_inverse=True)
    sums = np.zeros((len(points), 3))
    np.add.at(sums, at, colours)
    means = sums / np.bincount(at, minlength=len(points))[:, None]
    for number, colour in zip(points.tolist(), means.round().astype(np.uint8), strict=True):
        model.points3D[number].color = colour


def colours_at(pixels: Pixels, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bilinear colours (N, 3) of pixels (H, W, 3) at points (N, 2)."""
    height, width = pixels.shape[:2]
    # A point on the border has the colour of the border.
    x, y = points.T.clip([[0.0], [0.0]], [[width - 1.0], [height - 1.0]])
    left = np.floor(x).astype(np.intp)
    top = np.floor(y).astype(np.intp)
    right = np.minimum(left + 1, width - 1)
    bottom = np.minimum(top + 1, height - 1)
    share_x = (x - left)[:, None]
    share_y = (y - top)[:, None]
    above = (1 - share_x) * pixels[top, left] + share_x * pixels[top, right]
    below = (1 - share_x) * pixels[bottom, left] + share_x * pixels[bottom, right]
    return np.asarray((1 - share_y) * above + share_y * below)
