"""A renderer of textured rectangles: 3 x 3 rays per pixel, each showing the nearest rectangle."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, project, resized

Picture = NDArray[np.uint8]

RAYS = 3  # along each axis of a pixel; odd, so that one ray passes through the pixel's centre
SUN = np.array([0.41, -0.51, 0.76])  # the direction towards the light
AMBIENT, DIFFUSE = 0.72, 0.38
SKY = (210, 180, 145)  # BGR
MIN_DEPTH = 1e-3  # metres


@dataclass(frozen=True, eq=False)
class Surface:
    """The points `origin + u edge_u + v edge_v` for u, v in [0, 1], each (3,) float64 in metres.

    The texture is (H, W, 3) uint8 BGR, with its first row at v = 0. A surface is visible only from
    its front, where `edge_u` points right and `edge_v` down.
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

    @property
    def shaded(self) -> Picture:
        """The texture in sunlight, (H, W, 3) uint8 BGR."""
        shade = AMBIENT + DIFFUSE * max(0.0, float(self.normal @ SUN))
        return np.asarray(cv2.convertScaleAbs(self.texture, alpha=shade), np.uint8)


def render(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[FloatImage, FloatImage]:
    """Render an image (H, W, 3) float32 BGR in 0..255, and depth (H, W) float32 along the camera's
    axis.

    Depth is measured at pixel centres, in metres. The sky's depth is inf.
    """
    fine = resized(camera, RAYS)
    image = np.full((fine.height, fine.width, 3), SKY, np.uint8)
    nearness = np.zeros(image.shape[:2], np.float32)  # 1 / depth, 0 for the sky
    for surface in surfaces:
        if surface.normal @ (camera.centre - surface.origin) < MIN_DEPTH:
            continue
        rows, columns = _extent(surface, fine)
        # A (x, y, 1) = (u, v, 1) / depth is affine in the pixel. So comparisons need no division.
        axes = np.column_stack([surface.edge_u, surface.edge_v, surface.origin - fine.centre])
        A = np.linalg.inv(fine.K @ fine.R @ axes).astype(np.float32)
        y, x = (axis.astype(np.float32) for axis in np.ogrid[rows, columns])
        u, v, inverse = (row[0] * x + (row[1] * y + row[2]) for row in A)
        hit = (
            (inverse > nearness[rows, columns])
            & (u >= 0)
            & (u <= inverse)
            & (v >= 0)
            & (v <= inverse)
        )
        if hit.any():
            np.copyto(nearness[rows, columns], inverse, where=hit)
            np.divide(1, inverse, out=inverse, where=hit)
            texture, half = surface.shaded, np.float32(0.5)
            x, y = u * inverse * texture.shape[1] - half, v * inverse * texture.shape[0] - half
            colours = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            np.copyto(image[rows, columns], colours, where=hit[..., None])
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    with np.errstate(divide="ignore"):
        depth = 1 / nearness[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS]
    return np.asarray(small, np.float32), np.asarray(depth, np.float32)


def _extent(surface: Surface, camera: SizedCamera) -> tuple[slice, slice]:
    """Return the rows and columns that a surface can touch; all if the surface reaches behind the
    camera.
    """
    corners = [
        surface.origin + i * surface.edge_u + j * surface.edge_v for i in (0, 1) for j in (0, 1)
    ]
    pixels, depth = project(camera, np.array(corners))
    size = (camera.width, camera.height)
    if (depth < MIN_DEPTH).any():
        return slice(0, size[1]), slice(0, size[0])
    ends = np.clip([np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0)) + 1], 0, size)
    (left, top), (right, bottom) = ends.astype(int).tolist()
    return slice(top, bottom), slice(left, right)
