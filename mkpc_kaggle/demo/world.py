"""Worlds of a ground, three walls and boxes with drawn textures, and their cameras."""

from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mkpc_kaggle.demo.camera import Floats, SizedCamera, look_at, resized_camera
from mkpc_kaggle.demo.render import Surface
from mkpc_kaggle.geometry.coordinates import Pixels

Bgr = tuple[int, int, int]

TEXELS = 72  # per metre

# Colours of the ground, the three walls and their windows.
PAVING = (128, 136, 140)
STONE = (150, 175, 190)
BRICK = (85, 105, 165)
PLASTER = (150, 200, 215)
GLASS = (75, 70, 60)
FRAME = (205, 215, 220)

# Of the shapes of a texture: maximum side in metres, maximum aspect, contrast
STONE_LEAVES = (1.2, 0.6, 0.06)
PAINT_LEAVES = (0.9, 1.0, 0.4)
WINDOW_M = (1.3, 1.9)  # width, height
WINDOW_STEP_M = 3.1  # between the left or lower edges of two windows
# The grid of places for boxes, before each is moved by up to a metre.
COLUMNS_X_M = (-9.0, -4.5, 0.0, 4.5, 9.0)
ROWS_Y_M = (9.0, 12.5, 16.0)
BOX_SHARE = 0.65  # of the places that have a box
# Width, depth, height of a box.
MIN_BOX_M = (1.0, 1.0, 1.0)
MAX_BOX_M = (3.0, 3.0, 5.5)


class Shot(NamedTuple):
    """A camera of a scene: position and target in metres, (width, height) in pixels."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    focal: float  # over the long side
    size: tuple[int, int]
    roll: float  # in degrees


class DemoScene(NamedTuple):
    """The cameras of a scene; ``metres_per_unit`` is of the written poses."""

    metres_per_unit: float
    shots: tuple[Shot, ...]


SHOTS = (
    Shot((-5.0, -7.0, 1.7), (-2.0, 20.0, 4.0), 0.75, (800, 600), 0),
    Shot((-2.0, -6.0, 1.7), (-1.0, 20.0, 3.8), 0.80, (800, 533), 6),
    Shot((7.0, -2.0, 1.6), (-3.0, 20.0, 4.5), 0.85, (600, 800), -9),
    Shot((-1.0, 1.0, 3.2), (3.0, 19.0, 4.0), 1.60, (800, 600), 14),
    Shot((-9.0, 4.0, 1.7), (4.0, 20.0, 4.0), 0.95, (800, 600), -4),
    Shot((9.0, 4.5, 2.6), (-8.0, 19.0, 4.0), 1.00, (600, 800), 22),
    Shot((-8.0, -4.0, 5.0), (6.0, 18.0, 4.2), 1.60, (800, 533), -12),
)
WIDE = (1600, 1200)
TELE = (800, 600)
# Lenses of 1, 2 and 4 times the focal length. The wide photographs are as large as photographs of a
# phone, compared to a matcher's view: a tele photograph shows more detail of its part than that view.
TELEPHOTO = (
    Shot((-4.0, -6.0, 1.7), (-1.2, 20.0, 4.0), 0.75, WIDE, 2),
    Shot((3.0, -5.0, 1.7), (0.9, 20.0, 4.0), 0.75, WIDE, -3),
    Shot((-6.0, -5.0, 1.8), (-7.0, 18.0, 3.0), 1.50, TELE, 4),
    Shot((-3.5, -4.0, 1.8), (-2.0, 18.0, 4.0), 1.50, TELE, -2),
    Shot((4.0, -3.0, 1.8), (3.0, 17.0, 3.0), 1.50, TELE, 3),
    Shot((1.0, -2.0, 1.8), (7.0, 18.0, 4.0), 1.50, TELE, 0),
    Shot((-1.0, -5.0, 1.8), (-7.0, 18.0, 3.0), 3.00, TELE, -3),
    Shot((-3.5, -4.0, 1.8), (-2.0, 18.0, 4.0), 3.00, TELE, 2),
    Shot((4.0, -3.0, 1.8), (3.0, 17.0, 3.0), 3.00, TELE, 0),
    Shot((1.0, -2.0, 1.8), (7.0, 18.0, 4.0), 3.00, TELE, 4),
)
SCENES = {
    "courtyard": DemoScene(2.5, SHOTS),
    "market": DemoScene(1.0, SHOTS),
    "street": DemoScene(1.0, TELEPHOTO),
}


def build_world(
    name: str, *, seed: int = 0, image_scale: float = 1.0
) -> tuple[list[Surface], list[SizedCamera]]:
    """Return the surfaces and cameras of a world, in metres.

    Only the name and the seed decide its content.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    # All draws come from one generator: another order would change every world.
    surfaces = _surfaces(rng)
    cameras = []
    for position, target, focal, size, roll in SCENES[name].shots:
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
    paving = paint(rng, 40, 34, PAVING, is_stone=True)
    north = facade(rng, 28, 10, STONE)
    west = facade(rng, 34, 8.5, BRICK)
    east = facade(rng, 22, 7.5, PLASTER)
    # Corners: top left, top right, bottom left, as seen from the courtyard.
    surfaces = [
        quad((-20, 20, 0), (20, 20, 0), (-20, -14, 0), paving),
        quad((-14, 20, 10), (14, 20, 10), (-14, 20, 0), north),
        quad((-14, -14, 8.5), (-14, 20, 8.5), (-14, -14, 0), west),
        quad((14, 20, 7.5), (14, -2, 7.5), (14, 20, 0), east),
    ]
    for x, y in product(COLUMNS_X_M, ROWS_Y_M):
        if rng.random() < BOX_SHARE:
            centre = np.array([x, y]) + rng.uniform(-1, 1, 2)
            size = rng.uniform(MIN_BOX_M, MAX_BOX_M)
            surfaces += box(rng, centre, size, rng.uniform(-45, 45))
    return surfaces


def box(rng: np.random.Generator, centre: Floats, size: Floats, yaw: float) -> list[Surface]:
    """Return the four sides and the top of a painted box on the ground.

    `centre` is (x, y), `size` is (width, depth, height), `yaw` is in degrees.
    """
    width, depth, height = size.tolist()
    cos = np.cos(np.radians(yaw))
    sin = np.sin(np.radians(yaw))
    # The four corners (4, 2) of the ground plan, counter-clockwise from above.
    signs = np.array(
        [
            [-1, -1],
            [1, -1],
            [1, 1],
            [-1, 1],
        ]
    )
    # For points as rows, so it is the transpose of the usual rotation.
    turn = np.array(
        [
            [cos, sin],
            [-sin, cos],
        ]
    )
    unturned = signs * (width / 2, depth / 2)
    corners = unturned @ turn + centre
    low = np.column_stack([corners, np.full(4, 0.0)])
    high = np.column_stack([corners, np.full(4, height)])

    # Colours of one box are tones of one colour.
    blue, green, red = rng.integers(60, 205, 3).tolist()
    colour = (blue, green, red)
    lid = paint(rng, width, depth, colour)
    found = [quad(high[3], high[2], high[0], lid)]
    # Side i is between the corners i - 1 and i; the first is the one from corner 3 to corner 0.
    for i, width_m in enumerate((depth, width, depth, width)):
        side = paint(rng, width_m, height, colour)
        found.append(quad(high[i - 1], high[i], low[i - 1], side))
    return found


def quad(
    top_left: ArrayLike, top_right: ArrayLike, bottom_left: ArrayLike, picture: Pixels
) -> Surface:
    """Return the rectangle with these corners (3,), named as seen from the front."""
    corner = np.asarray(top_left, dtype=np.float64)
    edge_u = np.subtract(top_right, corner)
    edge_v = np.subtract(bottom_left, corner)
    return Surface(corner, edge_u, edge_v, picture)


def paint(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    colour: Bgr,
    *,
    is_stone: bool = False,
) -> Pixels:
    """Draw a dead-leaves texture: shapes of all sizes in tones of the colour.

    Source: Lee, Mumford and Huang 2001. The shapes are upright rectangles for stone, rotated
    ellipses with stronger tones for paint.
    """
    scale = min(TEXELS, 2000 / max(width_m, height_m))  # at most 2,000 pixels a side
    width = max(16, round(width_m * scale))
    height = max(16, round(height_m * scale))
    picture = np.full((height, width, 3), colour, dtype=np.uint8)
    count = width * height // 60
    max_side_m, max_aspect, contrast = STONE_LEAVES if is_stone else PAINT_LEAVES
    sides = _leaf_sides(rng, count, max_side_m * scale, max_aspect)
    centres = rng.uniform((0, 0), (width, height), (count, 2))
    angles = rng.uniform(0, 180, count)
    tones = _leaf_tones(rng, count, colour, contrast)
    for centre, side, angle, tone in zip(centres, sides, angles, tones, strict=True):
        if is_stone:
            low = (centre - side / 2).astype(int)
            high = (centre + side / 2).astype(int)
            cv2.rectangle(picture, low, high, tone, -1)
        else:
            cv2.ellipse(picture, (centre, side, angle), tone, -1, cv2.LINE_AA)
    return picture


def _leaf_sides(rng: np.random.Generator, count: int, max_side: float, max_aspect: float) -> Floats:
    """Draw the sides (count, 2) of shapes in pixels, from three to ``max_side``, largest first.

    Later shapes cover earlier ones, so small ones stay visible. Their density falls with the third
    power of their size: the texture looks alike at every scale.
    """
    draws = rng.uniform((3 / max_side) ** 2, 1, count)
    lengths = np.sort(3 / np.sqrt(draws))[::-1]
    aspects = rng.uniform(0.3, max_aspect, count)
    shapes = np.column_stack([np.ones(count), aspects])
    return np.asarray(lengths[:, None] * shapes)


def _leaf_tones(
    rng: np.random.Generator, count: int, colour: Bgr, contrast: float
) -> list[list[float]]:
    """Draw the BGR colours of shapes, which differ mostly in brightness and a little in hue."""
    brightness = rng.normal(0, contrast, (count, 1))
    hue = rng.normal(0, 0.2 * contrast, (count, 3))
    tones = np.array(colour) * (1 + brightness + hue)
    found: list[list[float]] = tones.clip(8, 250).tolist()
    return found


def facade(rng: np.random.Generator, width_m: float, height_m: float, colour: Bgr) -> Pixels:
    """Draw a stone wall with a grid of windows that differ only in brightness."""
    picture = paint(rng, width_m, height_m, colour, is_stone=True)
    scale = picture.shape[1] / width_m
    window_w, window_h = WINDOW_M
    w = int(window_w * scale)
    h = int(window_h * scale)
    # One pane for all windows: repetition is what makes facades hard to match.
    glass = paint(rng, window_w, window_h, GLASS)
    pane = cv2.resize(glass, (w, h))
    # The first windows are 1.2 m above the ground and from the left edge.
    for z in np.arange(1.2, height_m - window_h, WINDOW_STEP_M):
        for x in np.arange(1.2, width_m - window_w, WINDOW_STEP_M):
            left = int(x * scale)
            top = picture.shape[0] - int(z * scale) - h  # rows run down, z runs up
            # A frame of six pixels; OpenCV's rectangles include both corners.
            first = (left - 6, top - 6)
            last = (left + w + 5, top + h + 5)
            cv2.rectangle(picture, first, last, FRAME, -1)
            lit = np.clip(pane * rng.uniform(0.7, 1.6), 0, 255)
            picture[top : top + h, left : left + w] = lit
    return picture
