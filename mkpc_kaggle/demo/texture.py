"""Textures with mip levels, so that a surface seen from afar is averaged and does not flicker."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
FloatImage = NDArray[np.float32]

_SMALLEST_LEVEL = 8  # texels of the shorter side


@dataclass(frozen=True, eq=False)
class Texture:
    """All mip levels in one picture: the full one at the left, the halves stacked in a column to its right.

    atlas: (H, W, 3) uint8 BGR; origins, sizes: (levels, 2) float32, x before y, in texels of the atlas.
    """

    atlas: Picture
    origins: FloatImage
    sizes: FloatImage


def mipmap(picture: Picture) -> Texture:
    """The texture of a (H, W, 3) uint8 BGR picture."""
    levels = [picture]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST_LEVEL:
        height, width = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.uint8))
    height, width = picture.shape[:2]
    column_width = levels[1].shape[1] if len(levels) > 1 else 0
    atlas = np.zeros((height, width + column_width, 3), dtype=np.uint8)
    atlas[:, :width] = picture
    origins = [(0, 0)]
    y = 0
    for level in levels[1:]:
        atlas[y : y + level.shape[0], width : width + level.shape[1]] = level
        origins.append((width, y))
        y += level.shape[0]
    sizes = [(level.shape[1], level.shape[0]) for level in levels]
    return Texture(atlas, np.array(origins, dtype=np.float32), np.array(sizes, dtype=np.float32))


def to_picture(values: NDArray[np.floating]) -> Picture:
    """Colours of any range to uint8, cut at 0 and 255."""
    return np.asarray(np.clip(values, 0, 255), dtype=np.uint8)


def sample(texture: Texture, u: FloatImage, v: FloatImage, footprint: FloatImage) -> FloatImage:
    """Trilinear look-up: colours (H, W, 3) float32 in 0..255 at u, v in [0, 1], each (H, W) float32.

    `footprint` (H, W) is the distance in texels of the full level from one sample to the next.
    """
    top = len(texture.sizes) - 1
    # Half a level too sharp: every pixel averages several samples, which takes that much aliasing away.
    level = np.clip(np.log2(np.maximum(footprint, 1e-6)) - 0.5, 0, top)
    lower = level.astype(np.intp)
    fraction = (level - lower)[..., None]
    if not fraction.any():
        return _sample_level(texture, u, v, lower)
    below = _sample_level(texture, u, v, lower)
    above = _sample_level(texture, u, v, np.minimum(lower + 1, top))
    return np.asarray(below + fraction * (above - below), dtype=np.float32)


def _sample_level(texture: Texture, u: FloatImage, v: FloatImage, level: NDArray[np.intp]) -> FloatImage:
    """Bilinear look-up in one level per sample; clamped so that it never reads a neighbouring level."""
    coordinates = []
    for axis, share in enumerate((u, v)):
        size = texture.sizes[:, axis][level]
        inside = np.clip(share * size - np.float32(0.5), 0, size - 1)
        coordinates.append(inside + texture.origins[:, axis][level])
    colours = cv2.remap(texture.atlas, coordinates[0], coordinates[1], cv2.INTER_LINEAR)
    return np.asarray(colours, dtype=np.float32)
