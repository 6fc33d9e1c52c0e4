"""A renderer of textured rectangles: 3 x 3 rays per pixel, each showing the nearest rectangle."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, project, resized_camera
from mkpc_kaggle.geometry.coordinates import Pixels

RAYS = 3  # along each axis of a pixel; odd, so that one ray passes through the pixel's centre
SUN = np.array([0.41, -0.51, 0.76])  # the direction towards the light
# Shares of the light: 0.72 in the shade, up to 1.1 towards the sun.
AMBIENT = 0.72
DIFFUSE = 0.38
SKY = (210, 180, 145)  # BGR
MIN_DEPTH = 1e-3  # metres


@dataclass(frozen=True, eq=False)
class Surface:
    """A parallelogram by its top left, top right and bottom left corner, as seen from its front.

    Corners are in metres. The texture is (H, W, 3) uint8 BGR. A surface is visible only from its front.
    """

    corners: ArrayLike  # (3, 3)
    texture: Pixels

    @property
    def axes(self) -> Floats:
        """The top left corner, and the edges to the right and down, as rows (3, 3)."""
        corners = np.array(self.corners, np.float64)
        corners[1:] -= corners[0]
        return corners

    @property
    def normal(self) -> Floats:
        """The unit vector towards the front, (3,)."""
        _, right, down = self.axes
        normal = np.cross(down, right)
        return np.asarray(normal / np.linalg.norm(normal))

    @property
    def shaded(self) -> Pixels:
        """The texture in sunlight, (H, W, 3) uint8 BGR."""
        shade = AMBIENT + DIFFUSE * max(0.0, float(self.normal @ SUN))
        # OpenCV rounds and clips to 0..255.
        return np.asarray(cv2.convertScaleAbs(self.texture, alpha=shade), np.uint8)


def render(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[FloatImage, FloatImage]:
    """Render an image (H, W, 3) float32 BGR in 0..255, and its depth (H, W) float32.

    Depth is along the camera's axis, at pixel centres, in metres. The sky's depth is inf.
    """
    fine = resized_camera(camera, RAYS)
    image = np.full((fine.height, fine.width, 3), SKY, np.uint8)
    nearness = np.zeros(image.shape[:2], np.float32)  # 1 / depth, 0 for the sky
    for surface in surfaces:
        # Its back faces the camera.
        if surface.normal @ (camera.centre - surface.axes[0]) < MIN_DEPTH:
            continue
        _draw(surface, fine, image, nearness)
    # The mean of a pixel's rays.
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    with np.errstate(divide="ignore"):
        depth = 1 / nearness[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS]
    return np.asarray(small, np.float32), np.asarray(depth, np.float32)


def _draw(
    surface: Surface, camera: SizedCamera, image: Pixels, nearness: NDArray[np.float32]
) -> None:
    """Draw a surface where nothing nearer is drawn: change the image and ``nearness`` in place."""
    rows, columns = _extent(surface, camera)
    # A (x, y, 1) = (u, v, 1) / depth is affine in the pixel. So comparisons need no division.
    corner, right, down = surface.axes
    axes = np.column_stack([right, down, corner - camera.centre])
    A = np.linalg.inv(camera.K @ camera.R @ axes).astype(np.float32)
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


def _extent(surface: Surface, camera: SizedCamera) -> tuple[slice, slice]:
    """Return the rows and columns that a surface can touch.

    All of them if the surface reaches behind the camera, where its projection has no outline.
    """
    corner, right, down = surface.axes
    corners = [corner, corner + right, corner + down, corner + right + down]
    pixels, depth = project(camera, np.array(corners))
    size = (camera.width, camera.height)
    if (depth < MIN_DEPTH).any():
        return slice(0, camera.height), slice(0, camera.width)
    first = np.floor(pixels.min(axis=0))
    last = np.ceil(pixels.max(axis=0)) + 1
    left, top = np.clip(first, 0, size).astype(int).tolist()
    right, bottom = np.clip(last, 0, size).astype(int).tolist()
    return slice(top, bottom), slice(left, right)
