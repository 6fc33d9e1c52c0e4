"""Textured rectangles: all that a scene is made of."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.demo.texture import Texture

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """The points `origin + u edge_u + v edge_v` for u, v in [0, 1]; the texture's first row is at v = 0.

    origin, edge_u, edge_v: (3,) float64 in world units. The texture is laid `repeat` times along u and v,
    every other time mirrored so that there is no seam.
    """

    origin: Floats
    edge_u: Floats
    edge_v: Floats
    texture: Texture
    repeat: tuple[float, float] = (1.0, 1.0)


def scaled(surface: Surface, factor: float) -> Surface:
    """The surface in a world `factor` times as large."""
    return replace(
        surface,
        origin=surface.origin * factor,
        edge_u=surface.edge_u * factor,
        edge_v=surface.edge_v * factor,
    )


def wall(
    left: ArrayLike,
    right: ArrayLike,
    bottom: float,
    top: float,
    texture: Texture,
    repeat: tuple[float, float] = (1.0, 1.0),
) -> Surface:
    """An upright rectangle from (x, y) `left` to `right` as its viewer sees them, z from bottom to top."""
    a, b = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    return Surface(np.append(a, top), np.append(b - a, 0.0), np.array([0.0, 0.0, bottom - top]), texture, repeat)


def slab(
    low: ArrayLike, high: ArrayLike, z: float, texture: Texture, repeat: tuple[float, float] = (1.0, 1.0)
) -> Surface:
    """A level rectangle between the corners (x, y) `low` and `high`: a floor or a ceiling."""
    (x0, y0), (x1, y1) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return Surface(
        np.array([x0, y1, z]), np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y0 - y1, 0.0]), texture, repeat
    )


def box(
    centre: ArrayLike,
    size: ArrayLike,
    sides: tuple[Texture, ...],
    top: Texture,
    *,
    yaw: float = 0.0,
    base: float = 0.0,
    repeat: tuple[float, float] = (1.0, 1.0),
) -> tuple[Surface, ...]:
    """Four sides and the top of a box that stands at height `base` with its (x, y) centre at `centre`.

    `size` is (width, depth, height); `yaw` turns it, in degrees. `sides` are used in turn for the faces seen
    from the south, east, north and west.
    """
    width, depth, height = np.asarray(size, dtype=np.float64)
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, depth / 2)
    corners = corners @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(centre, dtype=np.float64)
    faces = [
        wall(corners[i], corners[(i + 1) % 4], base, base + height, sides[i % len(sides)], repeat)
        for i in range(4)
    ]
    up_left = np.append(corners[3], base + height)
    lid = Surface(
        up_left, np.append(corners[2] - corners[3], 0), np.append(corners[0] - corners[3], 0), top, repeat
    )
    return (*faces, lid)
