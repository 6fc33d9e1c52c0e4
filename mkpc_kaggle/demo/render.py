"""A renderer of textured rectangles: 3 x 3 rays per pixel, each showing the nearest rectangle."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, resized_camera
from mkpc_kaggle.geometry.coordinates import Pixels

RAYS = 3  # along each axis of a pixel; odd, so that one ray passes through the pixel's centre
SUN = (0.41, -0.51, 0.76)  # the direction towards the light
# Shares of the light: 0.72 in the shade, up to 1.1 towards the sun.
AMBIENT = 0.72
DIFFUSE = 0.38
SKY = (210, 180, 145)  # BGR
MIN_DEPTH = 1e-3  # metres


@dataclass(frozen=True, eq=False)
class Surface:
    """A parallelogram, visible only from its front.

    Its top left corner and its edges to the right and down, as seen from its front, are in metres.
    The texture is (H, W, 3) uint8 BGR.
    """

    corner: Floats  # (3,)
    right: Floats  # (3,)
    down: Floats  # (3,)
    texture: Pixels

    @property
    def normal(self) -> Floats:
        """The unit vector towards the front, (3,)."""
        normal = np.cross(self.down, self.right)
        return np.asarray(normal / np.linalg.norm(normal))

    @property
    def shaded(self) -> Pixels:
        """The texture in sunlight, (H, W, 3) uint8 BGR."""
        shade = AMBIENT + DIFFUSE * max(0.0, float(self.normal @ SUN))
        # OpenCV rounds and clips to 0..255.
        return np.asarray(cv2.convertScaleAbs(self.texture, alpha=shade), np.uint8)


def render(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[FloatImage, FloatImage]:
    """Render an image (H, W, 3) float32 BGR in 0..255, and its nearness (H, W) at pixel centres."""
    fine = resized_camera(camera, RAYS)
    image = np.full((fine.height, fine.width, 3), SKY, np.uint8)
    nearness = np.zeros(image.shape[:2], np.float32)
    for surface in surfaces:
        # Its back faces the camera.
        if surface.normal @ (camera.centre - surface.corner) < MIN_DEPTH:
            continue
        _draw(surface, fine, image, nearness)
    # The mean of a pixel's rays.
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    centres = nearness[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS]
    return np.asarray(small, np.float32), centres


def _draw(surface: Surface, camera: SizedCamera, image: Pixels, nearness: FloatImage) -> None:
    """Draw a surface where nothing nearer is drawn: change the image and ``nearness`` in place."""
    # From (u, v, 1), with u and v in 0..1 on the surface, to depth * (x, y, 1).
    axes = np.column_stack([surface.right, surface.down, surface.corner - camera.centre])
    to_image = camera.K @ camera.R @ axes
    rows, columns = _extent(to_image, camera)
    # Its inverse, (u, v, 1) / depth, is affine in the pixel. So comparisons need no division.
    A = np.linalg.inv(to_image).astype(np.float32)
    y, x = (axis.astype(np.float32) for axis in np.ogrid[rows, columns])
    # x is a row and y a column, so only the outer sum has the size of the image.
    u, v, inverse = (row[0] * x + (row[1] * y + row[2]) for row in A)
    hit = inverse > nearness[rows, columns]
    # 0 <= u <= 1 and 0 <= v <= 1, all divided by the depth.
    hit &= (u >= 0) & (u <= inverse)
    hit &= (v >= 0) & (v <= inverse)
    if not hit.any():
        return
    np.copyto(nearness[rows, columns], inverse, where=hit)
    # From here on the depth, where the surface is hit.
    np.divide(1, inverse, out=inverse, where=hit)
    texture = surface.shaded
    # A texture's first pixel centre is half a pixel from its edge.
    texture_x = u * inverse * texture.shape[1] - 0.5
    texture_y = v * inverse * texture.shape[0] - 0.5
    colours = cv2.remap(
        texture, texture_x, texture_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    np.copyto(image[rows, columns], colours, where=hit[..., None])


def _extent(to_image: Floats, camera: SizedCamera) -> tuple[slice, slice]:
    """Return the rows and columns that a surface can touch.

    All of them if the surface reaches behind the camera, where its projection has no outline.
    """
    x, y, depth = to_image @ [[0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]]
    if (depth < MIN_DEPTH).any():
        return slice(0, camera.height), slice(0, camera.width)
    rows = _span(y / depth, camera.height)
    columns = _span(x / depth, camera.width)
    return rows, columns


def _span(positions: Floats, size: int) -> slice:
    """Return the whole pixels in 0..size between the least and the greatest position."""
    first = np.floor(positions.min())
    last = np.ceil(positions.max())
    ends = np.clip([first, last + 1], 0, size)
    start, stop = ends.astype(int)
    return slice(start, stop)
