"""Worlds of a ground, three walls and boxes with drawn textures, and their cameras."""

from itertools import product
from math import hypot
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mkpc_kaggle.demo.camera import Floats, SizedCamera, look_at, resized_camera
from mkpc_kaggle.demo.render import Surface
from mkpc_kaggle.geometry.coordinates import Pixels

Point = tuple[float, float, float] | Floats  # (3,)

TEXELS = 72  # per metre

# Colours of the ground, the three walls and their windows.
PAVING = (128, 136, 140)
SANDSTONE = (150, 175, 190)
BRICK = (85, 105, 165)
PLASTER = (150, 200, 215)
GLASS = (75, 70, 60)
FRAME = (205, 215, 220)

# Of the shapes of a texture: the largest in metres, the largest aspect, and the contrast
STONE = (1.2, 0.6, 0.06)
PAINT = (0.9, 1.0, 0.4)
WINDOW_M = (1.3, 1.9)  # width, height
WINDOW_STEP_M = 3.1  # between the left or lower edges of two windows
# The grid of places for boxes, before each is moved by up to a metre.
COLUMNS_X_M = (-9.0, -4.5, 0.0, 4.5, 9.0)
ROWS_Y_M = (9.0, 12.5, 16.0)
BOX_SHARE = 0.65  # of the places that have a box
MIN_BOX_M = 1.0
MAX_BOX_M = (3.0, 3.0, 5.5)  # width, depth, height


class Shot(NamedTuple):
    """A camera of a scene: position and target in metres, (width, height) in pixels."""

    position: Point
    target: Point
    focal: float  # over the long side
    size: tuple[int, int]
    roll: float  # in degrees


LANDSCAPE = (800, 600)
PORTRAIT = (600, 800)
FILM = (800, 533)
WIDE = (1600, 1200)
SHOTS = (
    Shot((-5.0, -7.0, 1.7), (-2.0, 20.0, 4.0), 0.75, LANDSCAPE, 0),
    Shot((-2.0, -6.0, 1.7), (-1.0, 20.0, 3.8), 0.80, FILM, 6),
    Shot((7.0, -2.0, 1.6), (-3.0, 20.0, 4.5), 0.85, PORTRAIT, -9),
    Shot((-1.0, 1.0, 3.2), (3.0, 19.0, 4.0), 1.60, LANDSCAPE, 14),
    Shot((-9.0, 4.0, 1.7), (4.0, 20.0, 4.0), 0.95, LANDSCAPE, -4),
    Shot((9.0, 4.5, 2.6), (-8.0, 19.0, 4.0), 1.00, PORTRAIT, 22),
    Shot((-8.0, -4.0, 5.0), (6.0, 18.0, 4.2), 1.60, FILM, -12),
)
# Lenses of 1, 2 and 4 times the focal length. The wide photographs are as large as photographs of a
# phone, compared to a matcher's view: a tele photograph shows more detail of its part than that view.
TELEPHOTO = (
    Shot((-4.0, -6.0, 1.7), (-1.2, 20.0, 4.0), 0.75, WIDE, 2),
    Shot((3.0, -5.0, 1.7), (0.9, 20.0, 4.0), 0.75, WIDE, -3),
    Shot((-6.0, -5.0, 1.8), (-7.0, 18.0, 3.0), 1.50, LANDSCAPE, 4),
    Shot((-3.5, -4.0, 1.8), (-2.0, 18.0, 4.0), 1.50, LANDSCAPE, -2),
    Shot((4.0, -3.0, 1.8), (3.0, 17.0, 3.0), 1.50, LANDSCAPE, 3),
    Shot((1.0, -2.0, 1.8), (7.0, 18.0, 4.0), 1.50, LANDSCAPE, 0),
    Shot((-1.0, -5.0, 1.8), (-7.0, 18.0, 3.0), 3.00, LANDSCAPE, -3),
    Shot((-3.5, -4.0, 1.8), (-2.0, 18.0, 4.0), 3.00, LANDSCAPE, 2),
    Shot((4.0, -3.0, 1.8), (3.0, 17.0, 3.0), 3.00, LANDSCAPE, 0),
    Shot((1.0, -2.0, 1.8), (7.0, 18.0, 4.0), 3.00, LANDSCAPE, 4),
)
SCENES = {"courtyard": SHOTS, "market": SHOTS, "street": TELEPHOTO}


def build_world(
    name: str, *, image_scale: float = 1.0
) -> tuple[list[Surface], list[SizedCamera]]:
    """Return the surfaces and cameras of a world, in metres.

    Only the name decides its content.
    """
    rng = np.random.default_rng([0, *name.encode()])
    # All draws come from one generator: another order would change every world.
    surfaces = _surfaces(rng)
    cameras = []
    for position, target, focal, size, roll in SCENES[name]:
        eye = np.add(position, rng.uniform(-0.15, 0.15, 3))
        towards = np.add(target, rng.uniform(-0.3, 0.3, 3))
        turned = roll + rng.uniform(-2, 2)
        camera = look_at(eye, towards, focal * max(size), size, turned)
        cameras.append(resized_camera(camera, image_scale))
    return surfaces, cameras


def _surfaces(rng: np.random.Generator) -> list[Surface]:
    """Return surfaces in metres: x points east, y north, z up from the ground.

    The ground comes first, then the north wall (at y = 20), the west wall, the east wall and boxes.
    """
    surfaces = [
        painted(rng, (-20, 20, 0), (40, 0, 0), (0, -34, 0), PAVING, STONE),
        facade(rng, (-14, 20, 10), (28, 0, 0), SANDSTONE),
        facade(rng, (-14, -14, 8.5), (0, 34, 0), BRICK),
        facade(rng, (14, 20, 7.5), (0, -22, 0), PLASTER),
    ]
    for x, y in product(COLUMNS_X_M, ROWS_Y_M):
        if rng.random() < BOX_SHARE:
            centre = np.array([x, y]) + rng.uniform(-1, 1, 2)
            size = rng.uniform(MIN_BOX_M, MAX_BOX_M)
            surfaces += box(rng, centre, size, rng.uniform(-45, 45))
    return surfaces


def facade(
    rng: np.random.Generator, corner: Point, right: Point, colour: ArrayLike
) -> Surface:
    """Return a stone wall on the ground, with a grid of windows that differ only in brightness."""
    width_m = hypot(*right)
    height_m = corner[2]
    wall = painted(rng, corner, right, (0, 0, -height_m), colour, STONE)
    picture = wall.texture
    scale = picture.shape[1] / width_m
    width, height = WINDOW_M
    w = int(width * scale)
    h = int(height * scale)
    # One pane for all windows: repetition is what makes facades hard to match.
    pane = cv2.resize(paint(rng, width, height, GLASS, PAINT), (w, h))
    # The first windows are 1.2 m from the edges.
    for y in np.arange(1.2, height_m - height, WINDOW_STEP_M):
        for x in np.arange(1.2, width_m - width, WINDOW_STEP_M):
            left = int(x * scale)
            bottom = picture.shape[0] - int(y * scale)  # rows run down
            # A frame of six pixels; OpenCV's rectangles include both corners.
            frame = (left - 6, bottom - h - 6, w + 12, h + 12)
            cv2.rectangle(picture, frame, FRAME, -1)
            lit = np.clip(pane * rng.uniform(0.7, 1.6), 0, 255)
            picture[bottom - h : bottom, left : left + w] = lit
    return wall


def box(rng: np.random.Generator, centre: Floats, size: Floats, yaw: float) -> list[Surface]:
    """Return the top and the four sides of a painted box on the ground.

    `centre` is (x, y), `size` is (width, depth, height), `yaw` is in degrees.
    """
    # Counter-clockwise from above, beginning with the first side's left end.
    signs = np.array([[-1, 1], [-1, -1], [1, -1], [1, 1]])
    turn = cv2.getRotationMatrix2D((0, 0), yaw, 1)[:, :2]
    ground = signs * size[:2] / 2 @ turn + centre
    corners = np.column_stack([ground, np.full(4, size[2])])
    edges = np.roll(corners, -1, axis=0) - corners
    colour = rng.integers(60, 205, 3)  # the sides have tones of it
    top = painted(rng, corners[0], -edges[3], edges[0], colour, PAINT)
    down = (0, 0, -size[2])
    sides = [
        painted(rng, corner, edge, down, colour, PAINT)
        for corner, edge in zip(corners, edges, strict=True)
    ]
    return [top, *sides]


def painted(
    rng: np.random.Generator,
    corner: Point,
    right: Point,
    down: Point,
    colour: ArrayLike,
    leaves: tuple[float, float, float],
) -> Surface:
    """Return a surface with a painted texture of its size."""
    texture = paint(rng, hypot(*right), hypot(*down), colour, leaves)
    return Surface(np.asarray(corner), np.asarray(right), np.asarray(down), texture)


def paint(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    colour: ArrayLike,
    leaves: tuple[float, float, float],
) -> Pixels:
    """Draw a dead-leaves texture: shapes of all sizes in tones of the colour.

    Upright rectangles for stone, turned ellipses for paint.

    Source: Lee, Mumford and Huang 2001. Later leaves cover earlier ones, so the largest come first.
    Their density falls with the third power of their size: the texture looks alike at every scale.
    """
    scale = min(TEXELS, 2000 / max(width_m, height_m))  # at most 2,000 pixels a side
    width = max(16, round(width_m * scale))
    height = max(16, round(height_m * scale))
    picture = np.full((height, width, 3), colour, dtype=np.uint8)
    count = width * height // 60
    largest_m, max_aspect, contrast = leaves
    # From three texels on
    draws = rng.uniform((3 / (largest_m * scale)) ** 2, 1, count)
    lengths = np.sort(3 / np.sqrt(draws))[::-1]
    aspects = rng.uniform(0.3, max_aspect, count)
    sides = np.column_stack([lengths, lengths * aspects])
    centres = rng.uniform((0, 0), (width, height), (count, 2))
    angles = rng.uniform(0, 180, count)
    # They differ mostly in brightness and a little in hue.
    brightness = rng.normal(0, contrast, (count, 1))
    hue = rng.normal(0, 0.2 * contrast, (count, 3))
    shades = np.array(colour) * (1 + brightness + hue)
    tones = shades.clip(8, 250).tolist()
    for centre, side, angle, tone in zip(centres, sides, angles, tones, strict=True):
        if leaves is STONE:
            low = (centre - side / 2).astype(int)
            high = (centre + side / 2).astype(int)
            cv2.rectangle(picture, low, high, tone, -1)
        else:
            cv2.ellipse(picture, (centre, side, angle), tone, -1, cv2.LINE_AA)
    return picture
