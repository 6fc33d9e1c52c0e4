"""Lists of pairs with known poses, in the format of SuperGlue's evaluation.

One line per pair: ``name0 name1 turns0 turns1 K0 K1 T_0to1``, separated by blanks. Names are paths
under the image root. ``turns`` are the counter-clockwise quarter turns that set an image upright,
after its EXIF rotation. K (9 numbers) and T (16) are row-major and refer to the stored pixels. With
T = [R t; 0 1], X_1 = R X_0 + t.
"""

from math import nan
from pathlib import Path, PureWindowsPath

import numpy as np

from mkpc_kaggle.config import decimal, whole
from mkpc_kaggle.data.competition import Pair, TrainScene, TruePair, evenly_spread
from mkpc_kaggle.errors import UserError, read_text
from mkpc_kaggle.geometry.cameras import Camera

FIELDS = 2 + 2 + 9 + 9 + 16
EXPECTED = "name0 name1 turns0 turns1 K0 (9 numbers) K1 (9) T_0to1 (16)"


def read_pairs(file: Path, image_root: Path, *, most: int | None = None) -> TrainScene:
    """Return the pairs of a list as a scene of unknown scale.

    ``most`` limits the pairs, which are then evenly spread. An unreadable image is not an error
    here. Raises :class:`UserError` for a list without pairs and for a malformed line.
    """
    if not image_root.is_dir():
        raise UserError(f"{image_root}: no such directory")
    pairs = []
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        if line.split():
            pairs.append(parse_line(line, file, number, image_root))
    if not pairs:
        raise UserError(f"{file} has no pairs; expected lines {EXPECTED}")
    return TrainScene(file.stem, nan, tuple(evenly_spread(pairs, most)))


def parse_line(line: str, file: Path, number: int, image_root: Path) -> TruePair:
    """Return the pair of a line.

    Raises :class:`UserError` with the line's location and the expected format.
    """
    cells = line.split()
    where = f"{file}, line {number}"
    if len(cells) != FIELDS:
        raise UserError(f"{where}: expected {FIELDS} fields, {EXPECTED}, found {len(cells)}")
    names = cells[:2]
    for name in names:
        path = PureWindowsPath(name)  # the strictest rules: drives and backslashes count too
        if path.anchor or ".." in path.parts or "\0" in name:
            raise UserError(
                f"{where}: {name!r} points outside the image root; expected a path without .."
            )
    try:
        turns = (whole(cells[2]), whole(cells[3]))
        numbers = np.array([decimal(cell) for cell in cells[4:]])
    except ValueError as error:
        raise UserError(
            f"{where}: expected numbers for turns, K0, K1 and T_0to1: {error}"
        ) from error
    K0 = numbers[:9].reshape(3, 3)
    K1 = numbers[9:18].reshape(3, 3)
    T = numbers[18:].reshape(4, 4)
    if not np.isfinite(numbers).all() or not {*turns} <= {0, 1, 2, 3}:
        raise UserError(f"{where}: expected finite numbers, and 0, 1, 2 or 3 quarter turns")
    # Unique in a list that has the same images in several turns.
    labels = []
    for name, times in zip(names, turns, strict=True):
        labels.append(f"{name} turned {times}" if times else name)
    file0, file1 = (str(image_root / name) for name in names)
    pair = Pair(f"{number}: {' '.join(labels)}", file.stem, file0, file1, turns=turns)
    # The first camera is the world.
    camera0 = Camera(K0, np.eye(3), np.zeros(3))
    camera1 = Camera(K1, T[:3, :3], T[:3, 3])
    return TruePair(pair, camera0, camera1, nan)
