"""Lists of pairs with known poses, in the format that SuperGlue's evaluation made common.

A line a pair: ``name0 name1 turns0 turns1 K0 K1 T_0to1``, separated by blanks. Names are paths under one image
root. ``turns`` are the quarter turns, counter-clockwise, that set an image upright. K (9 numbers) and T (16), row
by row, are those of the images as they are stored: X_1 = R X_0 + t with T = [R t; 0 1].
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import nan
from pathlib import Path, PureWindowsPath

import cv2
import numpy as np

from mkpc_kaggle.data.competition import Pair, Scene, TruePair, evenly_spread
from mkpc_kaggle.data.images import Unreadable, read_image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.robust import ModelKind

FIELDS = 2 + 2 + 9 + 9 + 16
EXPECTED = "name0 name1 turns0 turns1 K0 (9 numbers) K1 (9) T_0to1 (16)"
ORTHOGONAL = 1e-3
"""How far R R^T of a pose may be from the identity: files have few digits."""


@dataclass(frozen=True, eq=False)
class PairLine:
    """One parsed line: ``names`` are relative paths, ``cameras`` those of the images before turning."""

    number: int
    names: tuple[str, str]
    turns: tuple[int, int]
    cameras: tuple[Camera, Camera]


def read_pairs(
    file: Path, image_root: Path, model: ModelKind | str, *, copies: Path, most: int | None = None
) -> Scene:
    """The pairs of a list as one scene of unknown scale, to estimate ``model``, E or F, on.

    ``most`` takes that many pairs, evenly spread over the list. A turned copy of every image that has to be turned
    is written to the directory ``copies``, and the cameras are those of the copies. An image that cannot be read
    is no error here: the run reports it. Raises :class:`UserError` for a missing or empty file, a malformed line,
    and a name that points outside ``image_root``.
    """
    if not image_root.is_dir():
        raise UserError(f"--image-root {image_root}: no such directory")
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{file} is not UTF-8 text") from error
    lines = [
        parse_line(line, number, file) for number, line in enumerate(text.splitlines(), start=1) if line.split()
    ]
    if not lines:
        raise UserError(f"{file} has no pairs; expected lines {EXPECTED}")

    @cache
    def upright(name: str, turns: int) -> UprightImage:
        return turned_copy(image_root / name, turns, copies)

    chosen = evenly_spread(lines, most)
    return Scene(file.stem, nan, tuple(_true_pair(line, upright, ModelKind(model), file.stem) for line in chosen))


def parse_line(line: str, number: int, file: Path) -> PairLine:
    """One line of a list; raises :class:`UserError` that names file, line and what was expected."""
    where, cells = f"{file}, line {number}", line.split()
    if len(cells) != FIELDS:
        raise UserError(f"{where}: expected {FIELDS} fields, {EXPECTED}, found {len(cells)}")
    names = confined(cells[0], where), confined(cells[1], where)
    turns = quarter_turns(cells[2], where), quarter_turns(cells[3], where)
    try:
        numbers = np.array([float(cell) for cell in cells[4:]])
    except ValueError as error:
        raise UserError(f"{where}: expected numbers for K0, K1 and T_0to1: {error}") from error
    if not np.isfinite(numbers).all():
        raise UserError(f"{where}: expected finite numbers for K0, K1 and T_0to1")
    K0, K1, T = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:].reshape(4, 4)
    for name, K in (("K0", K0), ("K1", K1)):
        if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] or tuple(K[2]) != (0, 0, 1):
            raise UserError(f"{where}: expected {name} = fx s cx 0 fy cy 0 0 1 with positive fx and fy")
    R, t = T[:3, :3], T[:3, 3]
    if tuple(T[3]) != (0, 0, 0, 1) or np.abs(R @ R.T - np.eye(3)).max() > ORTHOGONAL or np.linalg.det(R) < 0:
        raise UserError(f"{where}: expected T_0to1 = [R t; 0 0 0 1] with R a rotation")
    return PairLine(number, names, turns, (Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, R, t)))


def confined(name: str, where: str) -> str:
    """``name`` if it is a relative path that cannot point outside a directory."""
    # Windows' rules are the strictest: drives and backslashes, besides what is absolute elsewhere.
    path = PureWindowsPath(name)
    if path.anchor or ".." in path.parts or "\0" in name:
        raise UserError(
            f"{where}: the name {name!r} points outside the image root; expected a relative path without .."
        )
    return name


def quarter_turns(cell: str, where: str) -> int:
    if cell not in ("0", "1", "2", "3"):
        raise UserError(f"{where}: expected 0, 1, 2 or 3 quarter turns, found {cell!r}")
    return int(cell)


@dataclass(frozen=True)
class UprightImage:
    """An image to match; ``size`` is that before turning, ``None`` if it was not turned."""

    path: Path
    size: Size | None = None


def turned_copy(image: Path, turns: int, copies: Path) -> UprightImage:
    """The image turned by ``turns`` quarters, in ``copies``; ``image`` itself if unturned or unreadable."""
    picture = read_image(image) if turns else None
    if picture is None or isinstance(picture, Unreadable):
        return UprightImage(image)
    name = hashlib.sha256(os.fsencode(image)).hexdigest()[:16]
    path = copies / f"{image.stem}-{name}-{turns}.png"
    bgr = cv2.cvtColor(np.ascontiguousarray(np.rot90(picture.pixels, turns)), cv2.COLOR_RGB2BGR)
    try:
        copies.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", bgr)[1].tobytes())
    except OSError as error:
        raise UserError(f"the turned copy {path} cannot be written: {error.strerror}") from error
    return UprightImage(path, picture.size)


def _true_pair(
    line: PairLine, upright: Callable[[str, int], UprightImage], model: ModelKind, group: str
) -> TruePair:
    shown = [upright(name, turns) for name, turns in zip(line.names, line.turns, strict=True)]
    camera0, camera1 = (
        camera.rotated_90(turns, image.size) if image.size else camera
        for camera, turns, image in zip(line.cameras, line.turns, shown, strict=True)
    )
    names = " ".join(
        name + ("" if turns == 0 else f" turned {turns}")
        for name, turns in zip(line.names, line.turns, strict=True)
    )
    pair = Pair(
        f"{line.number}: {names}",
        group,
        str(shown[0].path),
        str(shown[1].path),
        (camera0.K, camera1.K) if model is ModelKind.E else None,
    )
    return TruePair(pair, camera0, camera1, nan)
