"""A renderer of textured rectangles: the nearest one per ray, 2 x 2 samples per pixel."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, project, resized

Picture = NDArray[np.uint8]
Window = tuple[slice, slice]  # rows and columns of an image

SAMPLES = 2  # along each axis of a pixel
SUN = np.array([0.41, -0.51, 0.76])  # the direction towards the light
AMBIENT, DIFFUSE = 0.72, 0.38
ZENITH, HORIZON = np.array([200, 140, 85], np.float32), np.array([235, 220, 205], np.float32)  # BGR
NO_SURFACE = -1
MIN_DEPTH = 1e-3  # world units
MIN_DISTANCE = 1e-6  # from camera to plane, in world units; a nearer plane is edge-on
MIN_LEVEL_PX = 8  # the shorter side of a texture's smallest level


@dataclass(frozen=True, eq=False)
class Surface:
    """The points `origin + u edge_u + v edge_v` for u, v in [0, 1], each (3,) float64 in world units.

    The texture is (H, W, 3) uint8 BGR; its first row is at v = 0.
    """

    origin: Floats
    edge_u: Floats
    edge_v: Floats
    texture: Picture

    @cached_property
    def levels(self) -> tuple[Picture, ...]:
        """The texture at full, half, quarter size and so on, against aliasing of distant surfaces."""
        levels = [self.texture]
        while min(levels[-1].shape[:2]) >= 2 * MIN_LEVEL_PX:
            height, width = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, dtype=np.uint8))
        return tuple(levels)


def render(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[FloatImage, FloatImage]:
    """Render a view: image (H, W, 3) float32 BGR in 0..255 and depth (H, W) float32 along the camera's axis.

    Depth is measured at the pixel's centre, in world units; inf for the sky.
    """
    fine = resized(camera, SAMPLES)
    index, _ = nearest_surface(surfaces, fine)
    image = _sky(fine)
    for number in np.unique(index[index != NO_SURFACE]).tolist():
        hit = index == number
        window = _bounds(hit)
        np.copyto(image[window], _colour(surfaces[number], fine, window), where=hit[window][..., None])
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    _, inverse_depth = nearest_surface(surfaces, camera)
    with np.errstate(divide="ignore"):
        return np.asarray(small, dtype=np.float32), np.float32(1) / inverse_depth


def nearest_surface(surfaces: Sequence[Surface], camera: SizedCamera) -> tuple[NDArray[np.int16], FloatImage]:
    """Return each pixel's index of the visible surface, -1 for none, and inverse depth, 0 for none."""
    index = np.full((camera.height, camera.width), NO_SURFACE, dtype=np.int16)
    best = np.zeros((camera.height, camera.width), dtype=np.float32)
    for number, surface in enumerate(surfaces):
        window = _extent(surface, camera)
        if window is None:
            continue
        q0, q1, q2 = _plane_coordinates(_plane_matrix(surface, camera), window)
        # 1 / depth is affine in the pixel; comparing it needs no division.
        nearer = (q2 > best[window]) & (q0 >= 0) & (q0 <= q2) & (q1 >= 0) & (q1 <= q2)
        np.copyto(best[window], q2, where=nearer)
        np.copyto(index[window], np.int16(number), where=nearer)
    return index, best


def sample_texture(levels: Sequence[Picture], u: FloatImage, v: FloatImage, footprint: FloatImage) -> FloatImage:
    """Sample colours (H, W, 3) float32 in 0..255, trilinearly, at u, v in [0, 1], each (H, W) float32.

    `footprint` (H, W) is the distance in texels of the full level from one sample to the next.
    """
    # Half a level sharper: the average of several samples per pixel removes the aliasing.
    wanted = np.clip(np.log2(np.maximum(footprint, 1e-6)) - 0.5, 0, len(levels) - 1)
    colours = np.zeros((*u.shape, 3), np.float32)
    for number, level in enumerate(levels):
        weight = np.clip(1 - np.abs(wanted - number), 0, 1)
        if weight.any():
            x, y = (share * size - np.float32(0.5) for share, size in ((u, level.shape[1]), (v, level.shape[0])))
            found = cv2.remap(level, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colours += weight[..., None] * found
    return colours


def _colour(surface: Surface, camera: SizedCamera, window: Window) -> FloatImage:
    A = _plane_matrix(surface, camera)
    q0, q1, q2 = _plane_coordinates(A, window)
    q2 = np.where(np.abs(q2) < 1e-9, np.float32(1e-9), q2)
    u, v = q0 / q2, q1 / q2
    height, width = surface.levels[0].shape[:2]
    # Squared distances in the texture of a step in x and of a step in y.
    steps = [
        np.square(width * (A[0, k] - u * A[2, k])) + np.square(height * (A[1, k] - v * A[2, k])) for k in range(2)
    ]
    footprint = np.asarray(np.sqrt(np.maximum(*steps)) / np.abs(q2), np.float32)
    normal = np.cross(surface.edge_u, surface.edge_v)
    normal *= np.sign(normal @ (camera.centre - surface.origin)) / np.linalg.norm(normal)
    shade = AMBIENT + DIFFUSE * max(0.0, float(normal @ SUN))
    return sample_texture(surface.levels, u, v, footprint) * np.float32(shade)


def _sky(camera: SizedCamera) -> FloatImage:
    """Render the whole image as sky, paler towards the horizon."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    east, north, up = (row[0] * x + row[1] * y + row[2] for row in camera.R.T @ np.linalg.inv(camera.K))
    height = np.clip(up / np.sqrt(east**2 + north**2 + up**2), 0, 1)[..., None]
    return np.asarray(HORIZON + (ZENITH - HORIZON) * height, dtype=np.float32)


def _plane_matrix(surface: Surface, camera: SizedCamera) -> Floats:
    """Return A (3, 3) with `A (x, y, 1) = (u, v, 1) / depth`: the inverse of `K [edge_u edge_v origin]`."""
    in_camera = camera.R @ np.column_stack([surface.edge_u, surface.edge_v, surface.origin])
    in_camera[:, 2] += camera.t
    return np.asarray(np.linalg.inv(camera.K @ in_camera), dtype=np.float64)


def _plane_coordinates(A: Floats, window: Window) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Return u / depth, v / depth and 1 / depth on the surface's plane at each pixel of the window."""
    x = np.arange(window[1].start, window[1].stop)[None, :]
    y = np.arange(window[0].start, window[0].stop)[:, None]
    a, b, c = ((row[0] * x).astype(np.float32) + (row[1] * y + row[2]).astype(np.float32) for row in A)
    return a, b, c


def _extent(surface: Surface, camera: SizedCamera) -> Window | None:
    """Return the image window that the surface can touch; None if it is outside or edge-on."""
    normal = np.cross(surface.edge_u, surface.edge_v)
    if abs(normal @ (camera.centre - surface.origin)) < MIN_DISTANCE * np.linalg.norm(normal):
        return None
    corners = np.array([surface.origin + i * surface.edge_u + j * surface.edge_v for i in (0, 1) for j in (0, 1)])
    pixels, depth = project(camera, corners)
    if (depth < MIN_DEPTH).all():
        return None
    size = (camera.width, camera.height)
    low, high = np.zeros(2, int), np.array(size)
    if (depth >= MIN_DEPTH).all():  # else it passes the camera, and its corners do not bound it
        low = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    if (low >= high).any():
        return None
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _bounds(mask: NDArray[np.bool_]) -> Window:
    """Return the smallest window that contains a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
