"""Boxes and views: the conversions of pixel coordinates.

Pixel centres are at integers: the centre of the top-left pixel is (0, 0), x runs right, y runs
down, and an image of width w covers [-0.5, w - 0.5). A resize by s gives ``x_view = (x + 0.5) * s -
0.5``. Each axis has its own s, computed from the *actual* sizes. A crop subtracts an integer
offset. A quarter turn swaps the axes and flips one of them. Padding is added right and bottom, so
coordinates do not change.

The matches of every unit become full-image pixels once: ``Pipeline._match`` (``pipeline/stages.py``) calls
``Matches.to_image``, which calls :meth:`View.to_image` for both images and drops matches on padding.

Before that, matchers with other conventions convert to pixel centres: LoFTR's family by :func:`from_corner`;
DKM, RoMa and LoMa by :func:`from_normalised`. ``sift_lightglue`` takes away the quarter of a pixel that
OpenCV adds. Points for COLMAP's files and functions are shifted by
``COLMAP_CENTRE_PX``.
"""

from dataclasses import dataclass
from math import ceil, sqrt
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Matrix3 = NDArray[np.float64]  # (3, 3)

COLMAP_CENTRE_PX = 0.5  # in COLMAP, the centre of the top-left pixel is (0.5, 0.5)


class Size(NamedTuple):
    """Width and height in pixels; the shape of an array has them in the other order."""

    width: int
    height: int


@dataclass(frozen=True)
class Box:
    """A half-open box of whole pixels: ``left <= x < right``, ``top <= y < bottom``.

    Parameters
    ----------
    left, top : int
        The first column and row.
    right, bottom : int
        One after the last column and row.

    Raises
    ------
    ValueError
        If the box has no pixels.

    Examples
    --------
    >>> from mkpc_kaggle import Box
    >>> Box(10, 20, 330, 260).size
    Size(width=320, height=240)
    """

    left: int
    top: int
    right: int
    bottom: int

    def __post_init__(self) -> None:
        if self.left >= self.right or self.top >= self.bottom:
            raise ValueError(f"an empty box: {self}")

    @classmethod
    def whole(cls, size: Size) -> "Box":
        return cls(0, 0, size.width, size.height)

    @property
    def size(self) -> Size:
        return Size(self.right - self.left, self.bottom - self.top)

    @property
    def area(self) -> int:
        return self.size.width * self.size.height

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return an (N,) mask of the points (N, 2), in image pixels, on the box's pixels.

        False for NaN.
        """
        x = points[:, 0]
        y = points[:, 1]
        # A pixel reaches half a pixel from its centre.
        in_columns = (x >= self.left - 0.5) & (x < self.right - 0.5)
        in_rows = (y >= self.top - 0.5) & (y < self.bottom - 0.5)
        return in_columns & in_rows


@dataclass(frozen=True)
class View:
    """A matcher's input: a crop of an image, turned, resized, and padded right and bottom.

    Image pixels are pixels of the file as stored, ignoring EXIF orientation.
    """

    crop: Box  # in image pixels
    content: Size  # of the crop, turned and resized
    padded: Size  # of the content with its padding
    turns: int = 0  # quarter turns, counter-clockwise, 0 to 3
    antialias: bool = True  # average areas where the crop shrinks

    @classmethod
    def fit(
        cls,
        crop: Box,
        *,
        long_side: int = 0,
        area: int = 0,
        multiple: int = 1,
        turns: int = 0,
    ) -> "View":
        """Return the view of ``crop`` with a longer side of ``long_side``, or with about ``area``.

        Both are in pixels. The aspect ratio is kept to the nearest pixel. Both sides are padded up
        to a multiple of ``multiple``, as in :meth:`stretched`.
        """
        scale = long_side / max(crop.size) if long_side else sqrt(area / crop.area)
        turned = _turned_size(crop.size, turns)
        # A thin crop keeps at least one row or column of pixels.
        width = max(1, round(turned.width * scale))
        height = max(1, round(turned.height * scale))
        return cls.stretched(crop, size=Size(width, height), multiple=multiple, turns=turns)

    @classmethod
    def stretched(cls, crop: Box, *, size: Size, multiple: int = 1, turns: int = 0) -> "View":
        """Return the view of ``crop``, turned and then resized to exactly ``size``.

        The aspect ratio may change.
        """
        padded_width = ceil(size.width / multiple) * multiple
        padded_height = ceil(size.height / multiple) * multiple
        return cls(crop, size, Size(padded_width, padded_height), turns)

    @property
    def scale(self) -> tuple[float, float]:
        """View pixels per pixel of the turned crop, (s_x, s_y)."""
        width, height = _turned_size(self.crop.size, self.turns)
        return self.content.width / width, self.content.height / height

    def from_image(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Convert (N, 2) image pixels to (N, 2) view pixels."""
        offset = np.array([self.crop.left, self.crop.top])
        # From the crop's corner: there, turns and scales need no half pixel.
        from_crop = np.asarray(points, np.float64) - offset + 0.5
        turned = _turned(from_crop, self.turns, self.crop.size)
        return np.asarray(turned * self.scale - 0.5, np.float64)

    def to_image(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Convert (N, 2) view pixels to (N, 2) image pixels, the inverse of :meth:`from_image`."""
        offset = np.array([self.crop.left, self.crop.top])
        turned_size = _turned_size(self.crop.size, self.turns)
        turned = (np.asarray(points, np.float64) + 0.5) / self.scale
        from_crop = _turned(turned, -self.turns, turned_size)
        return np.asarray(from_crop - 0.5 + offset, np.float64)

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return an (N,) mask of the points (N, 2), in view pixels, on content, not on padding.

        False for NaN.
        """
        return Box.whole(self.content).contains(points)

    def render(self, image: Pixels) -> Pixels:
        """Render the view of a uint8 image (H, W) or (H, W, 3), with ``padded`` height and width.

        Padding is black. Shrinking averages areas to avoid aliasing, unless ``antialias`` is off.
        All other resizing is bilinear. Both methods use the half-pixel convention of this module.
        """
        crop = self.crop
        cut = image[crop.top : crop.bottom, crop.left : crop.right]
        # A slice would silently be smaller, or count from the other end.
        if min(crop.left, crop.top) < 0 or cut.shape[1::-1] != crop.size:
            raise ValueError(
                f"{crop} leaves the image of {image.shape[1]} x {image.shape[0]} pixels"
            )
        # OpenCV's codes turn clockwise; code 0 is one quarter turn.
        picture = cv2.rotate(cut, 3 - self.turns) if self.turns else cut
        # Shrink first, then enlarge: INTER_AREA averages areas only if neither axis grows.
        turned = _turned_size(crop.size, self.turns)
        shrunk = turned
        if self.antialias:
            width = min(self.content.width, turned.width)
            height = min(self.content.height, turned.height)
            shrunk = Size(width, height)
        if shrunk != turned:
            picture = cv2.resize(picture, shrunk, interpolation=cv2.INTER_AREA)
        if shrunk != self.content:
            picture = cv2.resize(picture, self.content, interpolation=cv2.INTER_LINEAR)

        right = self.padded.width - self.content.width
        bottom = self.padded.height - self.content.height
        channels = ((0, 0),) * (image.ndim - 2)  # colours are not padded
        return np.pad(picture, ((0, bottom), (0, right), *channels))


def _turned_size(size: Size, turns: int) -> Size:
    return Size(size.height, size.width) if turns % 2 else size


def _turned(points: NDArray[np.float64], turns: int, size: Size) -> NDArray[np.float64]:
    """Rotate (N, 2) points like ``np.rot90`` rotates a picture of ``size``.

    Points are relative to the picture's top-left corner.
    """
    x, y = points.T
    width, height = size
    # After no, one, two and three counter-clockwise quarter turns.
    quarters = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)]
    return np.stack(quarters[turns % 4], axis=1)


def from_corner(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Move the origin of (N, 2) pixels from the image's corner to the centre of its first pixel."""
    return points - np.float32(0.5)


def from_normalised(points: NDArray[np.floating], size: Size) -> NDArray[np.floating]:
    """Convert (N, 2) coordinates, +-1 at the outer edges of an image of ``size``, to pixels."""
    return from_corner((points + 1) * np.array(size, points.dtype) / 2)
