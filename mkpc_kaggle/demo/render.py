"""A renderer of textured rectangles: the nearest one per ray, 3 x 3 rays per pixel."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, project, resized

Picture = NDArray[np.uint8]

RAYS = 3  # along each axis of a pixel; odd, so that one of them is the pixel's centre
SUN = np.array([0.41, -0.51, 0.76])  # the direction towards the light
AMBIENT, DIFFUSE = 0.72, 0.38
SKY = (210, 180, 145)  # BGR
MIN_DEPTH = 1e-3  # metres
MIN_LEVEL_PX = 8  # the shorter side of a texture's smallest level


@dataclass(frozen=True, eq=False)
class Surface:
    """The points `origin + u edge_u + v edge_v` for u, v in [0, 1], each (3,) float64 in metres.

    The texture is (H, W, 3) uint8 BGR; its first row is at v = 0. It is seen from the front alone, from where
    `edge_u` points right and `edge_v` down.
    """

    origin: Floats
    edge_u: Floats
    edge_v: Floats
    texture: Picture

    @property
    def normal(self) -> Floats:
        """The unit vector towards the front, (3,)."""
        normal = np.cross(self.edge_v, self.edge_u)
        return np.asarray(normal / np.linalg.norm(normal))

    @cached_property
    def levels(self) -> list[Picture]:
        """The shaded texture at full, half, quarter size and so on, against aliasing of distant surfaces."""
        shade = AMBIENT + DIFFUSE * max(0.0, float(self.normal @ SUN))
        levels = [cv2.convertScaleAbs(self.texture, alpha=shade)]
        while min(levels[-1].shape[:2]) >= 2 * MIN_LEVEL_PX:
            height, width = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            levels.append(half)
        return levels  # type: ignore[return-value]  # of uint8, as the texture


def render(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[FloatImage, FloatImage]:
    """Render a view: image (H, W, 3) float32 BGR in 0..255 and depth (H, W) float32 along the camera's axis.

    Depth is measured at the pixel's centre, in metres; inf for the sky.
    """
    fine = resized(camera, RAYS)
    image = np.full((fine.height, fine.width, 3), SKY, np.uint8)
    nearness = np.zeros(image.shape[:2], np.float32)  # 1 / depth, 0 for the sky
    for surface in surfaces:
        if surface.normal @ (camera.centre - surface.origin) < MIN_DEPTH:
            continue
        rows, columns = _extent(surface, fine)
        # A (x, y, 1) = (u, v, 1) / depth, which is affine in the pixel; comparing it needs no division.
        axes = np.column_stack([surface.edge_u, surface.edge_v, surface.origin - fine.centre])
        A = np.linalg.inv(fine.K @ fine.R @ axes).astype(np.float32)
        y, x = (axis.astype(np.float32) for axis in np.ogrid[rows, columns])
        u, v, inverse = (row[0] * x + (row[1] * y + row[2]) for row in A)
        hit = (inverse > nearness[rows, columns]) & (u >= 0) & (u <= inverse) & (v >= 0) & (v <= inverse)
        if hit.any():
            np.copyto(nearness[rows, columns], inverse, where=hit)
            np.divide(1, inverse, out=inverse, where=hit)
            colours = _colours(surface, A, u * inverse, v * inverse, inverse)
            np.copyto(image[rows, columns], colours, where=hit[..., None])
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    with np.errstate(divide="ignore"):
        depth = 1 / nearness[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS]
    return np.asarray(small, np.float32), np.asarray(depth, np.float32)


def _extent(surface: Surface, camera: SizedCamera) -> tuple[slice, slice]:
    """Return the rows and columns that the surface can touch: all of them if it passes the camera."""
    corners = [surface.origin + i * surface.edge_u + j * surface.edge_v for i in (0, 1) for j in (0, 1)]
    pixels, depth = project(camera, np.array(corners))
    size = (camera.width, camera.height)
    if (depth < MIN_DEPTH).any():
        return slice(0, size[1]), slice(0, size[0])
    ends = np.clip([np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0)) + 1], 0, size)
    (left, top), (right, bottom) = ends.astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _colours(surface: Surface, A: FloatImage, u: FloatImage, v: FloatImage, depth: FloatImage) -> Picture:
    """Return colours (H, W, 3) at u, v and depth, each (H, W), of the surface's plane."""
    height, width = surface.texture.shape[:2]
    # Squared distances in texels of a step in x and of a step in y, over the squared depth.
    squares = [(width * (A[0, k] - u * A[2, k])) ** 2 + (height * (A[1, k] - v * A[2, k])) ** 2 for k in (0, 1)]
    texels = (np.sqrt(np.maximum(*squares)) * depth).clip(1, 2.0 ** (len(surface.levels) - 1))
    wanted = np.log2(texels).astype(np.uint8)
    colours = np.empty((*u.shape, 3), np.uint8)
    for number in np.unique(wanted).tolist():
        level = surface.levels[number]
        x, y = u * level.shape[1] - np.float32(0.5), v * level.shape[0] - np.float32(0.5)
        found = cv2.remap(level, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        np.copyto(colours, found, where=(wanted == number)[..., None])
    return colours
