"""Files of the Image Matching Challenge 2022: the test side, the train side, submissions.

A cell holds the numbers of a matrix or vector row by row, separated by blanks. A test image is
``test_images/<batch_id>/<image_id>.png``, a train image ``<scene>/images/<image_id>.jpg``. Both
sides accept the other suffixes of :mod:`mkpc_kaggle.data.images`, too. F of a pair satisfies
x2^T F x1 = 0, where x1 is in the first image.
"""

import csv
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import decimal
from mkpc_kaggle.data.images import IMAGE_SUFFIXES, MORE_SUFFIXES
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError, open_regular, plural
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Matrix3

SUBMISSION_COLUMNS = ("sample_id", "fundamental_matrix")
MAX_LINE = 1 << 24  # characters that are read at once: a line without an end is refused

# Characters that end lines or control a terminal.
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
# Names that are empty, "." or "..", or contain a Windows drive, a slash or a control character.
NOT_PLAIN = re.compile(rf"^\.{{0,2}}$|^[A-Za-z]:|[/\\]|{CONTROL.pattern}")


@dataclass(frozen=True, slots=True)
class Pair:
    """Two images to match."""

    id: str  # unique in a run
    group: str  # its batch or scene
    # Paths of the images; text saves memory, since a table may have a million rows
    file0: str
    file1: str
    # Counter-clockwise quarter turns of each image before matching
    turns: tuple[int, int] = (0, 0)

    @property
    def images(self) -> tuple[Path, Path]:
        return Path(self.file0), Path(self.file1)

    @property
    def names(self) -> tuple[str, str]:
        """The file names, without folders."""
        # Not by Path: a table may have a million rows.
        name0 = self.file0.rpartition(os.sep)[2]
        name1 = self.file1.rpartition(os.sep)[2]
        return name0, name1


@dataclass(frozen=True, eq=False)
class TruePair:
    """A pair with its true cameras."""

    pair: Pair
    camera0: Camera
    camera1: Camera
    covisibility: float


@dataclass(frozen=True, eq=False)
class TrainScene:
    """A scene with known cameras, for scores."""

    name: str
    metres_per_unit: float  # NaN if unknown
    pairs: tuple[TruePair, ...]


def distinct_pairs(rows: Iterable[Pair]) -> tuple[list[Pair], NDArray[np.int_]]:
    """Return the distinct pairs of a table, the first row of each, and the pair of each row.

    Rows of a batch with the same two images are one pair: they share its points and its estimate.
    """
    pairs: list[Pair] = []
    known: dict[Any, int] = {}
    pair_of_row = []
    for pair in rows:
        key = (pair.group, pair.file0, pair.file1, pair.turns)
        if key not in known:
            known[key] = len(pairs)
            pairs.append(pair)
        pair_of_row.append(known[key])
    return pairs, np.array(pair_of_row, int)


def names_of(pair: Pair, root: str) -> tuple[str, str]:
    """Return the paths of a pair's images below ``root``."""
    return name_below(root, pair.file0), name_below(root, pair.file1)


def name_below(root: str, file: str) -> str:
    """Return a file's path relative to ``root``, or the whole path if the file lies elsewhere."""
    return file.removeprefix(root.rstrip("/") + "/") if root else file


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Return pair indices in an order that puts pairs with a common image together, for encoding
    cache hits.
    """
    # The group first: a batch that is finished early gets its scene early.
    keys = [(pair.group, pair.file0, pair.file1) for pair in pairs]
    return sorted(range(len(pairs)), key=keys.__getitem__)


def test_side(directory: Path) -> tuple[Path, Path]:
    """Return the paths of ``test.csv`` and ``test_images/``."""
    home = directory.parent if directory.name == "test_images" else directory
    return home / "test.csv", home / "test_images"


def read_test_side(directory: Path) -> tuple[Pair, ...]:
    """Return the pairs of ``test.csv``, in its order. A missing image is not an error here.

    ``directory`` holds ``test.csv`` and ``test_images/``, or is ``test_images/`` itself. Raises
    :class:`UserError` for an unreadable or empty table, a repeated sample id, and an unusable id.
    """
    path, images = test_side(directory)
    pairs: dict[str, Pair] = {}
    files = cache(lambda batch: image_files(images / batch))  # each folder is listed once
    columns = ("sample_id", "batch_id", "image_1_id", "image_2_id")
    for where, (sample, *ids) in read_rows(path, columns):
        if sample in pairs:
            raise UserError(f"{where}: the sample_id {sample!r} is not unique")
        if CONTROL.search(sample):
            raise UserError(
                f"{where}: the sample_id {sample!r} has control characters: no submission can hold it"
            )
        batch, first, second = (plain_name(name, where) for name in ids)
        path_of = files(batch)
        # A large table names a batch in thousands of rows: interning shares one string.
        pairs[sample] = Pair(sample, sys.intern(batch), path_of(first), path_of(second))
    if not images.is_dir():
        raise UserError(
            f"{images}: no such directory; --test-dir must hold test.csv and test_images/"
        )
    if not pairs:
        raise UserError(f"{path} has no rows, so no pair can be matched")
    return tuple(pairs.values())


def missing_line(pairs: Iterable[Pair]) -> str:
    """Return a line on the images of pairs that are missing; empty if all exist."""
    wanted = dict.fromkeys(file for pair in pairs for file in (pair.file0, pair.file1))
    # Path raises for a name that is too long.
    missing = [file for file in wanted if not os.path.exists(file)]  # noqa: PTH110
    if not missing:
        return ""
    return f"missing: {len(missing)} of {plural(len(wanted), 'image')}, the first is {missing[0]}"


def read_train_side(
    directory: Path,
    *,
    scenes: Iterable[str] = (),
    min_covisibility: float = 0.1,
    pairs_per_scene: int | None = None,
) -> tuple[TrainScene, ...]:
    """Return the named scenes, or all, with up to ``pairs_per_scene`` pairs each.

    Pairs are spread evenly over a scene's table. Raises :class:`UserError` for missing files and
    scenes, and for malformed cells.
    """
    metres = {}
    rows = read_rows(directory / "scaling_factors.csv", ("scene", "scaling_factor"))
    for where, (scene, cell) in rows:
        metres[plain_name(scene, where)] = float(*finite_numbers(cell, where, 1))
    # The table may name scenes that were not downloaded.
    wanted = list(scenes) or sorted(name for name in metres if (directory / name).is_dir())
    if not wanted:
        raise UserError(f"{directory} has none of the scenes of its scaling_factors.csv")
    if unknown := [name for name in wanted if name not in metres]:
        raise UserError(
            f"{directory}: unknown scene {unknown[0]!r}; known: {', '.join(sorted(metres))}"
        )
    return tuple(
        _read_scene(directory / name, metres[name], min_covisibility, pairs_per_scene)
        for name in wanted
    )


def _read_cameras(path: Path) -> dict[str, Camera]:
    """Return the cameras of a scene by image id."""
    cameras: dict[str, Camera] = {}
    columns = ("image_id", "camera_intrinsics", "rotation_matrix", "translation_vector")
    for where, (image, *cells) in read_rows(path, columns):
        K = finite_numbers(cells[0], where, 9).reshape(3, 3)
        R = finite_numbers(cells[1], where, 9).reshape(3, 3)
        t = finite_numbers(cells[2], where, 3)
        cameras[plain_name(image, where)] = Camera(K, R, t)
    return cameras


def _read_scene(
    directory: Path, metres: float, min_covisibility: float, most: int | None
) -> TrainScene:
    """Return a scene with its pairs of at least ``min_covisibility``."""
    cameras = _read_cameras(directory / "calibration.csv")
    images = image_files(directory / "images")
    path = directory / "pair_covisibility.csv"
    pairs = []
    for where, (key, cell) in read_rows(path, ("pair", "covisibility")):
        covisibility = float(*finite_numbers(cell, where, 1))
        first, _, second = key.partition("-")
        if first not in cameras or second not in cameras:
            raise UserError(f"{where}: the pair {key!r} is not two images of calibration.csv")
        if covisibility >= min_covisibility:
            pair = Pair(
                f"{directory.name};{key}", directory.name, images(first), images(second)
            )
            pairs.append(TruePair(pair, cameras[first], cameras[second], covisibility))
    if not pairs:
        raise UserError(
            f"{path} has no pair with a covisibility of at least {min_covisibility:g}"
        )
    return TrainScene(directory.name, metres, tuple(evenly_spread(pairs, most)))


def write_submission(path: Path, rows: Mapping[str, Matrix3]) -> None:
    """Write a row for each sample.

    If writing fails, an existing file stays unchanged, and ``OSError`` is raised.
    """
    with replacing(path) as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(SUBMISSION_COLUMNS)
        for sample, F in rows.items():
            numbers = [f"{value:.12g}" for value in F.ravel().tolist()]
            table.writerow((sample, " ".join(numbers)))


def read_submission(path: Path) -> dict[str, Matrix3]:
    """Return F by sample id. Raise :class:`UserError` for a file that is not a submission."""
    found = {}
    for where, (sample, cell) in read_rows(path, SUBMISSION_COLUMNS):
        found[sample] = finite_numbers(cell, where, 9).reshape(3, 3)
    return found


def submission_problem(path: Path, sample_ids: Sequence[str]) -> str:
    """Return the first wrong line of a submission; empty if the competition accepts the file."""
    wanted = iter(sample_ids)
    try:
        for where, (sample, cell) in read_rows(path, SUBMISSION_COLUMNS):
            expected = next(wanted, "no more rows")
            if sample != expected:
                return f"{where}: the sample is {sample}, and {expected} was expected"
            if not finite_numbers(cell, where, 9).any():
                return f"{where}: the matrix is zero"
    except UserError as error:
        return str(error)
    return next((f"{path} ends before sample {sample}" for sample in wanted), "")


def read_rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each row of a CSV file as its location, for messages, and its cells in ``columns``.

    Cells are the text of the file: ids such as "007", "1e3" and "NA" are no numbers. Empty lines are
    skipped. Raises :class:`UserError` for a file that is not a table with these columns, and for its
    first wrong line.
    """
    try:
        with (
            open_regular(path) as file,
            TextIOWrapper(file, encoding="utf-8-sig", newline="") as stream,
        ):
            # ``strict``: a quoted cell without an end is an error, and not the rest of the file.
            lines = iter(partial(stream.readline, MAX_LINE), "")
            table = csv.DictReader(lines, strict=True)
            header = table.fieldnames or ()
            if missing := [column for column in columns if column not in header]:
                found = ", ".join(header)[:200] or "none"
                raise UserError(
                    f"{path}: missing columns {', '.join(missing)}; it has {found}"
                )
            for row in table:
                where = f"{path}, line {table.line_num}"
                # As the reader stands for cells beyond the header, and for missing ones
                if None in row or None in row.values():
                    raise UserError(f"{where}: the header has {plural(len(header), 'cell')}")
                yield where, [row[column] for column in columns]
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path} cannot be read as a table: {reason}") from error


def plain_name(name: str, where: str) -> str:
    """Return ``name`` if it is a plain file name.

    Raises :class:`UserError` if it may lead out of its directory.
    """
    if NOT_PLAIN.search(name):
        raise UserError(
            f"{where}: the id {name!r} is not a plain name, so it cannot name a file here"
        )
    return name


def evenly_spread(items: Sequence[Any], most: int | None) -> list[Any]:
    """Return up to ``most`` items, evenly spread from the first to the last."""
    count = len(items) if most is None else min(most, len(items))
    indices = np.linspace(0, len(items) - 1, count).round().astype(int)
    return [items[index] for index in indices]


def image_files(directory: Path) -> Callable[[str], str]:
    """List a directory. Return a function from image id to path.

    An unknown id gives the path of a missing png.
    """
    known: dict[str, str] = {}
    # The directory is missing, or its name is too long or not encodable.
    with suppress(OSError, ValueError):
        paths = sorted(directory.iterdir())
        # Of "a.jpg" and "a.png", the first one counts; other formats come after both.
        for suffixes in (IMAGE_SUFFIXES, MORE_SUFFIXES):
            for path in paths:
                if path.suffix.lower() in suffixes:
                    known.setdefault(path.stem, str(path))
    return lambda name: known.get(name) or f"{directory}{os.sep}{name}.png"


def finite_numbers(cell: str, where: str, count: int) -> NDArray[np.float64]:
    """Return the ``count`` numbers of a cell. Raise :class:`UserError` for any other cell."""
    # Blanks alone: readers of the competition's files may not take other white space.
    parts = [part for part in cell.split(" ") if part]
    with suppress(ValueError):
        numbers = np.array([decimal(part) for part in parts])
        if len(parts) == count and np.isfinite(numbers).all():
            return numbers
    raise UserError(f"{where}: expected {count} finite numbers, found {cell!r}")
