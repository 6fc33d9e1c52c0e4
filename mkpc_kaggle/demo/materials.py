"""Pictures for the surfaces: what can be drawn with noise, rectangles and cuts of the photographs.

Pictures are (H, W, 3) uint8 BGR; sizes are (width, height) in texels. All chance comes from the generator.
"""

from itertools import pairwise

import cv2
import numpy as np

from mkpc_kaggle.demo.photographs import LATTICE, TREES, Photographs, crop, random_cut
from mkpc_kaggle.demo.texture import FloatImage, Picture, to_picture

Colour = tuple[int, int, int]


def fractal(
    rng: np.random.Generator, size: tuple[int, int], *, cells: int = 4, persistence: float = 0.7
) -> FloatImage:
    """Noise of all scales, (H, W) float32 of zero mean and unit deviation; `cells` of the coarsest scale."""
    width, height = size
    octaves = max(1, int(np.log2(max(size) / cells)))
    total = np.zeros((1, 1), dtype=np.float32)
    for octave in range(octaves):
        shrink = 2 ** (octaves - octave)
        grid = (max(1, width // shrink), max(1, height // shrink))
        total = np.asarray(cv2.resize(total, grid, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
        total += np.float32(persistence**octave) * rng.standard_normal(grid[::-1], dtype=np.float32)
    total = np.asarray(cv2.resize(total, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    return np.asarray((total - total.mean()) / total.std(), dtype=np.float32)


def weathered(rng: np.random.Generator, picture: Picture, strength: float = 0.1) -> Picture:
    """The picture with stains and grain, so that no two places look the same and there is detail close up."""
    height, width = picture.shape[:2]
    stains = 1 + np.float32(strength) * fractal(rng, (width, height), persistence=0.85)
    return to_picture(picture * stains[..., None])


def masonry(
    rng: np.random.Generator,
    size: tuple[int, int],
    stone: tuple[int, int],
    colour: Colour,
    *,
    spread: float = 0.12,
    joint: int = 3,
) -> Picture:
    """Courses of stones, every second one shifted by half a stone; each stone has a tone of its own."""
    width, height = size
    stone_width, stone_height = stone
    paint = np.array(colour, dtype=np.float32)
    picture = np.full((height, width, 3), 0.6 * paint, dtype=np.float32)
    for row, y in enumerate(range(0, height, stone_height)):
        for x in range(-(row % 2) * stone_width // 2, width, stone_width):
            tone = paint * (1 + spread * rng.standard_normal() + 0.015 * rng.standard_normal(3))
            picture[y : y + stone_height - joint, max(0, x) : max(0, x + stone_width - joint)] = tone
    return weathered(rng, to_picture(picture))


def plaster(rng: np.random.Generator, size: tuple[int, int], colour: Colour) -> Picture:
    """A painted wall: blotches, cracks and chips."""
    width, height = size
    picture = np.full((height, width, 3), colour, dtype=np.uint8)
    for _ in range(max(4, width * height // 30_000)):
        start = rng.uniform((0, 0), size)
        path = start + np.cumsum(rng.normal(rng.normal(0, 3, 2), 4, (int(rng.integers(4, 40)), 2)), axis=0)
        tone = _toned(colour, rng.uniform(0.5, 0.85))
        cv2.polylines(picture, [path.astype(np.int32)], False, tone, int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(width * height // 6_000):
        centre = rng.integers((0, 0), size)
        tone = _toned(colour, rng.uniform(0.65, 1.15))
        cv2.ellipse(
            picture,
            (int(centre[0]), int(centre[1])),
            (int(rng.integers(2, 10)), int(rng.integers(1, 6))),
            float(rng.uniform(0, 180)),
            0,
            360,
            tone,
            -1,
            cv2.LINE_AA,
        )
    return weathered(rng, picture, 0.07)


def windows(
    rng: np.random.Generator, photographs: Photographs, wall: Picture, columns: int, rows: int, frame: Colour
) -> Picture:
    """The wall with a grid of windows that differ only in how bright they are and how far a blind is down."""
    picture = wall.copy()
    height, width = picture.shape[:2]
    w, h = int(width / columns * 0.42), int(height / rows * 0.56)
    pane = crop(photographs.china, LATTICE, (w, h))
    for row in range(rows):
        for column in range(columns):
            x = int((column + 0.5) * width / columns) - w // 2
            y = int((row + 0.5) * height / rows) - h // 2
            margin = max(2, w // 12)
            cv2.rectangle(picture, (x - margin, y - margin), (x + w + margin, y + h + margin), frame, -1)
            cv2.rectangle(
                picture, (x - 2 * margin, y + h + margin), (x + w + 2 * margin, y + h + 3 * margin), frame, -1
            )
            glass = to_picture(pane * np.float32(rng.uniform(0.7, 1.25)))
            glass[: int(h * rng.uniform(0, 0.5) * (rng.random() < 0.4))] = int(rng.integers(90, 200))
            picture[y : y + h, x : x + w] = glass
    return picture


def collage(
    rng: np.random.Generator, photographs: Photographs, size: tuple[int, int], columns: int, rows: int
) -> Picture:
    """A mural: a grid of random cuts of the photographs, some mirrored, in colours of their own."""
    width, height = size
    picture = np.zeros((height, width, 3), dtype=np.uint8)
    ys = _uneven_steps(rng, height, rows)
    for top, bottom in pairwise(ys):
        xs = _uneven_steps(rng, width, columns)
        for left, right in pairwise(xs):
            picture[top:bottom, left:right] = random_cut(rng, photographs, (right - left, bottom - top))
    return weathered(rng, picture, 0.06)


def with_posters(
    rng: np.random.Generator, photographs: Photographs, wall: Picture, count: int, largest: float = 0.12
) -> Picture:
    """The wall with `count` bills stuck on it, their longer side up to `largest` of the wall's longer one."""
    picture = wall.copy()
    height, width = picture.shape[:2]
    for _ in range(count):
        w, h = (int(side) for side in rng.uniform(0.35, 1.0, 2) * largest * max(width, height))
        w, h = min(w, width - 1), min(h, height - 1)
        x, y = int(rng.integers(0, width - w)), int(rng.integers(0, height - h))
        picture[y : y + h, x : x + w] = random_cut(rng, photographs, (w, h))
    return picture


def framed(picture: Picture, border: int, colour: Colour) -> Picture:
    inner = cv2.copyMakeBorder(
        picture, border // 3, border // 3, border // 3, border // 3, cv2.BORDER_CONSTANT, value=(225, 230, 232)
    )
    return np.asarray(
        cv2.copyMakeBorder(inner, border, border, border, border, cv2.BORDER_CONSTANT, value=colour),
        dtype=np.uint8,
    )


def sky_panorama(rng: np.random.Generator, photographs: Photographs) -> Picture:
    """Clouds all round, hills and trees at the horizon: 2048 x 682 texels, see `render`."""
    width, height = 2048, 682
    horizon = height * 3 // 4
    down = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    blue = np.array((215, 160, 105)) * (1 - down) + np.array((240, 225, 205)) * down
    clouds = np.clip(fractal(rng, (width, height), cells=6, persistence=0.6) * 0.5, 0, 1)[..., None]
    picture = to_picture(blue + (np.float32(250) - blue) * clouds)
    trees = crop(photographs.china, TREES, (width // 4, height - horizon + 40))
    picture[horizon - 40 :] = weathered(rng, np.tile(np.hstack([trees, trees[:, ::-1]]), (1, 2, 1)), 0.25)
    return picture


def _uneven_steps(rng: np.random.Generator, length: int, parts: int) -> list[int]:
    inner = (np.arange(1, parts) + rng.uniform(-0.25, 0.25, parts - 1)) * length / parts
    return [0, *(int(value) for value in inner), length]


def _toned(colour: Colour, factor: float) -> tuple[float, float, float]:
    blue, green, red = colour
    return blue * factor, green * factor, red * factor
