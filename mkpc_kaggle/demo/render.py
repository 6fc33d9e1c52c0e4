"""The renderer: rays against textured rectangles, the nearest wins, 2 x 2 samples a pixel."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.demo.camera import Camera, Floats, resized
from mkpc_kaggle.demo.surface import Surface
from mkpc_kaggle.demo.texture import FloatImage, Texture, sample

_SAMPLES = 2  # along each axis of a pixel
_AMBIENT, _DIFFUSE = 0.72, 0.38
_NO_SURFACE = -1
_NEAR = 1e-3  # depth in world units
_EDGE_ON = 1e-6  # distance of the camera from a plane, in world units


def render(
    surfaces: Sequence[Surface], sky: Texture, camera: Camera, sun: ArrayLike = (0.4, -0.5, 0.8)
) -> tuple[FloatImage, FloatImage]:
    """One view: image (H, W, 3) float32 BGR in 0..255 and depth (H, W) float32 along the camera's axis.

    Depth is that of the pixel's centre, in world units, inf where the sky is seen. `sky` is a panorama: its
    columns go once round the horizon, its rows from the zenith down to 30 degrees below the horizon. `sun` is
    the direction towards the light, of any length.
    """
    direction = np.asarray(sun, dtype=np.float64) / np.linalg.norm(sun)
    image = _render_colour(surfaces, sky, camera, direction)
    _, inverse_depth = nearest_surface(surfaces, camera)
    with np.errstate(divide="ignore"):
        return image, np.float32(1) / inverse_depth


def _render_colour(surfaces: Sequence[Surface], sky: Texture, camera: Camera, sun: Floats) -> FloatImage:
    fine = resized(camera, _SAMPLES)
    index, _ = nearest_surface(surfaces, fine)
    image = np.zeros((fine.height, fine.width, 3), dtype=np.float32)
    for i in (np.flatnonzero(np.bincount(index.ravel() - _NO_SURFACE)) + _NO_SURFACE).tolist():
        hit = index == i
        window = _bounds(hit)
        colour = (
            _sky_colour(sky, fine, window) if i == _NO_SURFACE else _surface_colour(surfaces[i], fine, window, sun)
        )
        np.copyto(image[window], colour, where=hit[window][..., None])
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def nearest_surface(surfaces: Sequence[Surface], camera: Camera) -> tuple[NDArray[np.int16], FloatImage]:
    """For each pixel the index of the surface seen, -1 for none, and the inverse depth, 0 for none."""
    index = np.full((camera.height, camera.width), _NO_SURFACE, dtype=np.int16)
    best = np.zeros((camera.height, camera.width), dtype=np.float32)
    for i, surface in enumerate(surfaces):
        window = _extent(surface, camera)
        if window is None:
            continue
        q0, q1, q2 = _plane_coordinates(surface, camera, window)
        # 1 / depth is affine in the pixel; comparing it needs no division.
        nearer = (q2 > best[window]) & (q0 >= 0) & (q0 <= q2) & (q1 >= 0) & (q1 <= q2)
        np.copyto(best[window], q2, where=nearer)
        np.copyto(index[window], np.int16(i), where=nearer)
    return index, best


def _plane_matrix(surface: Surface, camera: Camera) -> Floats:
    """A (3, 3) with `A (x, y, 1) = (u, v, 1) / depth`: the inverse of `K [edge_u edge_v origin]`."""
    plane = np.column_stack([surface.edge_u, surface.edge_v, surface.origin])
    in_camera = camera.R @ plane
    in_camera[:, 2] += camera.t
    return np.asarray(np.linalg.inv(camera.K @ in_camera), dtype=np.float64)


def _plane_coordinates(
    surface: Surface, camera: Camera, window: tuple[slice, slice]
) -> tuple[FloatImage, FloatImage, FloatImage]:
    """The values u / depth, v / depth and 1 / depth on the surface's plane at each pixel of the window."""
    x = np.arange(window[1].start, window[1].stop)[None, :]
    y = np.arange(window[0].start, window[0].stop)[:, None]
    a, b, c = (
        (row[0] * x).astype(np.float32) + (row[1] * y + row[2]).astype(np.float32)
        for row in _plane_matrix(surface, camera)
    )
    return a, b, c


def _surface_colour(surface: Surface, camera: Camera, window: tuple[slice, slice], sun: Floats) -> FloatImage:
    q0, q1, q2 = _plane_coordinates(surface, camera, window)
    q2 = np.where(np.abs(q2) < 1e-9, np.float32(1e-9), q2)
    A = _plane_matrix(surface, camera).astype(np.float32)
    texels_u, texels_v = surface.texture.sizes[0] * np.array(surface.repeat, dtype=np.float32)
    u, v = q0 / q2, q1 / q2
    # How far one step in x, and one in y, moves in the texture; squared.
    steps = [
        np.square(texels_u * (A[0, k] - u * A[2, k])) + np.square(texels_v * (A[1, k] - v * A[2, k]))
        for k in range(2)
    ]
    footprint = np.sqrt(np.maximum(*steps)) / np.abs(q2)
    colour = sample(surface.texture, _laid(u, surface.repeat[0]), _laid(v, surface.repeat[1]), footprint)
    return colour * np.float32(_shade(surface, camera, sun))


def _laid(share: FloatImage, repeat: float) -> FloatImage:
    """The texture's coordinate where it is laid `repeat` times: a triangle wave, 0 to 1 and back to 0."""
    if repeat == 1:
        return share
    return np.asarray(1 - np.abs(1 - np.mod(share * np.float32(repeat), np.float32(2))), dtype=np.float32)


def _shade(surface: Surface, camera: Camera, sun: Floats) -> float:
    normal = np.cross(surface.edge_u, surface.edge_v)
    normal /= np.linalg.norm(normal)
    towards_us = np.sign(normal @ (camera.centre - surface.origin)) * normal
    return _AMBIENT + _DIFFUSE * max(0.0, float(towards_us @ sun))


def _sky_colour(sky: Texture, camera: Camera, window: tuple[slice, slice]) -> FloatImage:
    x = np.arange(window[1].start, window[1].stop)[None, :]
    y = np.arange(window[0].start, window[0].stop)[:, None]
    east, north, up = (
        (row[0] * x + row[1] * y + row[2]).astype(np.float32) for row in camera.R.T @ np.linalg.inv(camera.K)
    )
    azimuth = np.arctan2(east, north) / np.float32(2 * np.pi) + np.float32(0.5)
    elevation = np.arctan2(up, np.hypot(east, north))
    row = (np.float32(np.pi / 2) - elevation) / np.float32(np.radians(120))
    texels_per_pixel = float(sky.sizes[0, 0]) / (2 * np.pi * camera.K[0, 0])
    return sample(sky, azimuth, row, np.full(row.shape, texels_per_pixel, dtype=np.float32))


def _extent(surface: Surface, camera: Camera) -> tuple[slice, slice] | None:
    """The window of the image that the surface can touch; None when there is none or it is seen edge-on."""
    normal = np.cross(surface.edge_u, surface.edge_v)
    if abs(normal @ (camera.centre - surface.origin)) < _EDGE_ON * np.linalg.norm(normal):
        return None
    corners = np.array([surface.origin + i * surface.edge_u + j * surface.edge_v for i in (0, 1) for j in (0, 1)])
    image = (corners @ camera.R.T + camera.t) @ camera.K.T
    if (image[:, 2] < _NEAR).all():
        return None
    if (image[:, 2] < _NEAR).any():  # it passes the camera: its outline is not that of its corners
        return slice(0, camera.height), slice(0, camera.width)
    pixels = image[:, :2] / image[:, 2:]
    low = np.clip(np.floor(pixels.min(axis=0)), 0, (camera.width, camera.height)).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (camera.width, camera.height)).astype(int)
    if (low >= high).any():
        return None
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _bounds(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The smallest window with all of a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
