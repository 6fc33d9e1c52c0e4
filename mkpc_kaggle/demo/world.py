"""Worlds of a ground, three walls and boxes with drawn textures, and their cameras."""

from itertools import product

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mkpc_kaggle.demo.camera import Floats, SizedCamera, look_at, resized
from mkpc_kaggle.demo.render import Picture, Surface

Colour = tuple[int, int, int]  # BGR

SCENES = {"courtyard": 2.5, "market": 1.0}  # metres per unit of the written poses

TEXELS = 72  # per metre
STONE, BRICK, PLASTER, PAVING = (150, 175, 190), (85, 105, 165), (150, 200, 215), (128, 136, 140)
GLASS, FRAME = (75, 70, 60), (205, 215, 220)
WINDOW_M, WINDOW_STEP_M = (1.3, 1.9), 3.1
COLUMNS_X_M, ROWS_Y_M = (-9.0, -4.5, 0.0, 4.5, 9.0), (9.0, 12.5, 16.0)  # of the boxes
MIN_BOX_M, MAX_BOX_M = (1.0, 1.0, 1.0), (3.0, 3.0, 5.5)  # width, depth, height

# Position and target in metres, focal length over the long side, size in pixels, roll in degrees.
SHOTS = (
    ((-5.0, -7.0, 1.7), (-2.0, 20.0, 4.0), 0.75, (800, 600), 0),
    ((-2.0, -6.0, 1.7), (-1.0, 20.0, 3.8), 0.80, (800, 533), 6),
    ((7.0, -2.0, 1.6), (-3.0, 20.0, 4.5), 0.85, (600, 800), -9),
    ((-1.0, 1.0, 3.2), (3.0, 19.0, 4.0), 1.60, (800, 600), 14),
    ((-9.0, 4.0, 1.7), (4.0, 20.0, 4.0), 0.95, (800, 600), -4),
    ((9.0, 4.5, 2.6), (-8.0, 19.0, 4.0), 1.00, (600, 800), 22),
    ((-8.0, -4.0, 5.0), (6.0, 18.0, 4.2), 1.60, (800, 533), -12),
)


def build_world(
    name: str, *, seed: int = 0, image_scale: float = 1.0
) -> tuple[list[Surface], list[SizedCamera]]:
    """Return the surfaces and cameras of a world, in metres. Only the name and the seed decide its
    content.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    surfaces, cameras = _surfaces(rng), []
    for position, target, focal, size, roll in SHOTS:
        eye, towards = (
            np.add(position, rng.uniform(-0.15, 0.15, 3)),
            np.add(target, rng.uniform(-0.3, 0.3, 3)),
        )
        camera = look_at(eye, towards, focal * max(size), size, roll + rng.uniform(-2, 2))
        cameras.append(resized(camera, image_scale))
    return surfaces, cameras


def _surfaces(rng: np.random.Generator) -> list[Surface]:
    """Return surfaces in metres: x points east, y north (the north wall is at 20), z up from the
    ground.
    """
    surfaces = [
        quad((-20, 20, 0), (20, 20, 0), (-20, -14, 0), paint(rng, 40, 34, PAVING, is_stone=True)),
        quad((-14, 20, 10), (14, 20, 10), (-14, 20, 0), facade(rng, 28, 10, STONE)),
        quad((-14, -14, 8.5), (-14, 20, 8.5), (-14, -14, 0), facade(rng, 34, 8.5, BRICK)),
        quad((14, 20, 7.5), (14, -2, 7.5), (14, 20, 0), facade(rng, 22, 7.5, PLASTER)),
    ]
    for x, y in product(COLUMNS_X_M, ROWS_Y_M):
        if rng.random() < 0.65:
            centre, size = (
                np.array([x, y]) + rng.uniform(-1, 1, 2),
                rng.uniform(MIN_BOX_M, MAX_BOX_M),
            )
            surfaces += box(rng, centre, size, rng.uniform(-45, 45))
    return surfaces


def box(rng: np.random.Generator, centre: Floats, size: Floats, yaw: float) -> list[Surface]:
    """Return the four sides and the top of a painted box on the ground.

    `centre` is (x, y), `size` is (width, depth, height), `yaw` is in degrees.
    """
    width, depth, height = size.tolist()
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, depth / 2)
    corners = corners @ np.array([[cos, sin], [-sin, cos]]) + centre
    low, high = (np.column_stack([corners, np.full(4, z)]) for z in (0.0, height))
    blue, green, red = rng.integers(60, 205, 3).tolist()
    lid, *sides = (
        paint(rng, width_m, height_m, (blue, green, red))
        for width_m, height_m in ((width, depth), *2 * ((depth, height), (width, height)))
    )
    return [
        quad(high[3], high[2], high[0], lid),
        *(quad(high[i - 1], high[i], low[i - 1], side) for i, side in enumerate(sides)),
    ]


def quad(
    top_left: ArrayLike, top_right: ArrayLike, bottom_left: ArrayLike, picture: Picture
) -> Surface:
    """Return the rectangle with these corners (3,), named as seen from the front."""
    corner = np.asarray(top_left, dtype=np.float64)
    return Surface(
        corner, np.subtract(top_right, corner), np.subtract(bottom_left, corner), picture
    )


def paint(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    colour: Colour,
    *,
    is_stone: bool = False,
) -> Picture:
    """Draw a dead-leaves texture (Lee, Mumford and Huang 2001): shapes of all sizes in tones of the
    colour.

    The shapes are upright rectangles for stone, rotated ellipses with stronger tones for paint.
    """
    scale = min(TEXELS, 2000 / max(width_m, height_m))
    width, height = max(16, round(width_m * scale)), max(16, round(height_m * scale))
    picture = np.full((height, width, 3), colour, dtype=np.uint8)
    contrast, max_side_m = (0.06, 1.2) if is_stone else (0.4, 0.9)
    count = width * height // 60
    # The density of sizes falls with their third power, so the texture looks alike at every scale.
    lengths = np.sort(3 / np.sqrt(rng.uniform((3 / (max_side_m * scale)) ** 2, 1, count)))[::-1]
    sides = lengths[:, None] * np.column_stack(
        [np.ones(count), rng.uniform(0.3, 0.6 if is_stone else 1, count)]
    )
    centres, angles = rng.uniform((0, 0), (width, height), (count, 2)), rng.uniform(0, 180, count)
    tones = np.array(colour) * (
        1 + rng.normal(0, contrast, (count, 1)) + rng.normal(0, 0.2 * contrast, (count, 3))
    )
    for centre, side, angle, tone in zip(
        centres, sides, angles, tones.clip(8, 250).tolist(), strict=True
    ):
        if is_stone:
            low, high = (centre - side / 2).astype(int), (centre + side / 2).astype(int)
            cv2.rectangle(picture, low, high, tone, -1)
        else:
            cv2.ellipse(picture, (centre, side, angle), tone, -1, cv2.LINE_AA)
    return picture


def facade(rng: np.random.Generator, width_m: float, height_m: float, colour: Colour) -> Picture:
    """Draw a stone wall with a grid of windows that differ only in brightness."""
    picture = paint(rng, width_m, height_m, colour, is_stone=True)
    scale = picture.shape[1] / width_m
    w, h = int(WINDOW_M[0] * scale), int(WINDOW_M[1] * scale)
    pane = cv2.resize(paint(rng, *WINDOW_M, GLASS), (w, h))
    for z in np.arange(1.2, height_m - WINDOW_M[1], WINDOW_STEP_M):
        for x in np.arange(1.2, width_m - WINDOW_M[0], WINDOW_STEP_M):
            left, top = int(x * scale), picture.shape[0] - int(z * scale) - h
            cv2.rectangle(picture, (left - 6, top - 6), (left + w + 5, top + h + 5), FRAME, -1)
            picture[top : top + h, left : left + w] = np.clip(pane * rng.uniform(0.7, 1.6), 0, 255)
    return picture
