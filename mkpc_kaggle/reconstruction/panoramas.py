"""Panoramas of 360 degrees, which no camera model here describes.

Their projection is equirectangular: twice as wide as high, the left border continues at the right
one, and the first and the last row are one point each. A photograph of this shape is no panorama.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mkpc_kaggle.config import Range
from mkpc_kaggle.data.images import Image, read_image, read_size
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Pixels, Size

# Photographs of this shape whose pixels are looked at; phones make thousands of them.
MAX_SAMPLES = 10
MAX_PIXELS = 150_000_000  # of an image that is decoded here; more are judged by their metadata
MAX_ROWS = 401  # that are compared; their number is odd, so the middle one is among them
HEAD_BYTES = 1 << 17  # of a file, which has its XMP there
MARK = b"equirectangular"  # the value of GPano:ProjectionType in XMP
# Of the difference between neighbouring columns: the borders of a panorama are neighbours, too.
# Two black borders are more alike than that.
SEAM = Range(0.3, 2.0)
# Of the spread of the middle row: each row at a pole shows a single point.
MAX_POLE_SPREAD = 0.3


def require_perspective(files: Iterable[Path]) -> None:
    """Raise :class:`UserError` if one of the first images of a panorama's shape is a panorama."""
    samples = 0
    for file in files:
        size = read_size(file)
        if size is None or not has_shape(size):
            continue
        samples += 1
        if samples > MAX_SAMPLES:
            return
        if has_mark(file) or (size.width * size.height <= MAX_PIXELS and is_panorama(file)):
            raise UserError(
                f"{file} is a panorama of 360 degrees ({size.width} x {size.height}), and cameras here are "
                "perspective; cut each panorama into perspective views of about 90 degrees first"
            )


def is_panorama(file: Path) -> bool:
    """Return whether the pixels of a file are a panorama's."""
    image = read_image(file)
    return isinstance(image, Image) and wraps(image.pixels)


def has_shape(size: Size) -> bool:
    """Return whether an image is twice as wide as high, up to rounding."""
    return abs(size.width - 2 * size.height) <= 2


def has_mark(file: Path) -> bool:
    """Return whether a file's metadata call it a panorama."""
    try:
        with file.open("rb") as stream:
            return MARK in stream.read(HEAD_BYTES)
    except OSError:  # the run reports it
        return False


def wraps(pixels: Pixels) -> bool:
    """Return whether the borders of pixels (H, W, 3) fit together as a panorama's do."""
    # Some rows are enough; all of a large image would fill the memory.
    rows = np.unique(np.linspace(0, len(pixels) - 1, MAX_ROWS).round().astype(np.intp))
    values = pixels[rows].astype(np.float32)
    neighbours = np.abs(np.diff(values, axis=1)).mean(axis=(0, 2))
    # In a JPEG, the border is one between blocks of eight columns, too.
    usual = float(max(np.median(neighbours), np.median(neighbours[7::8])))
    seam = float(np.abs(values[:, 0] - values[:, -1]).mean())
    spreads = values.std(axis=1).mean(axis=1)  # of each row
    poles = max(float(spreads[0]), float(spreads[-1]))
    # In a picture without structure, any borders fit together.
    return (
        usual > 0 and seam / usual in SEAM and poles <= MAX_POLE_SPREAD * spreads[len(spreads) // 2]
    )
