"""Files of the Image Matching Challenge 2022: the test side, the train side, submissions.

Matrices and vectors in cells are separated by blanks, row by row. A test image is
``test_images/<batch_id>/<image_id>.png``, a train image ``<scene>/images/<image_id>.jpg``; png, jpg and
jpeg are accepted on both sides. F of a pair satisfies x2^T F x1 = 0, image 1 being the first.
"""

import csv
import gc
import os
import re
import secrets
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TextIO, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.robust import Matrix3, ModelKind

TEST_COLUMNS = ("sample_id", "batch_id", "image_1_id", "image_2_id")
SUBMISSION_COLUMNS = ("sample_id", "fundamental_matrix")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
"""Characters that end lines, or drive a terminal."""
NOT_PLAIN = re.compile(rf"^\.{{0,2}}$|^[A-Za-z]:|[/\\]|{CONTROL.pattern}")
"""Names of directories, of drives (Windows), and of no file."""

MOST_COLUMNS = 1000
"""Of a table: with a hundred thousand, pandas takes minutes."""

Item = TypeVar("Item")

_parts: set[Path] = set()
"""Files that :func:`replacing` is writing."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two images to match: ``id`` is unique in a run, ``group`` the batch or scene they belong to.

    ``file0`` and ``file1`` are the images' paths; as text, since a table may have a million rows. With
    ``intrinsics``, the camera matrices, E is estimated instead of F.
    """

    id: str
    group: str
    file0: str
    file1: str
    intrinsics: tuple[Matrix3, Matrix3] | None = field(default=None, compare=False)

    @property
    def image0(self) -> Path:
        return Path(self.file0)

    @property
    def image1(self) -> Path:
        return Path(self.file1)

    @property
    def images(self) -> tuple[Path, Path]:
        return self.image0, self.image1

    @property
    def names(self) -> tuple[str, str]:
        """The names of the images' files."""
        return self.file0.rpartition(os.sep)[2], self.file1.rpartition(os.sep)[2]

    @property
    def model(self) -> ModelKind:
        return ModelKind.F if self.intrinsics is None else ModelKind.E

    @property
    def key(self) -> str:
        """What identifies it in a journal: the id, and the intrinsics that E depends on."""
        return self.id if self.intrinsics is None else f"{self.id} {[K.tolist() for K in self.intrinsics]}"


@dataclass(frozen=True, eq=False)
class TruePair:
    """A pair of the train side with its cameras."""

    pair: Pair
    camera0: Camera
    camera1: Camera
    covisibility: float


@dataclass(frozen=True, eq=False)
class Scene:
    """Pairs with cameras, and the metres that one unit of their world is long, NaN where that is unknown."""

    name: str
    metres_per_unit: float
    pairs: tuple[TruePair, ...]


def test_side(directory: Path) -> tuple[Path, Path]:
    """The table and the directory of the images of a test side."""
    home = directory.parent if directory.name == "test_images" else directory
    return home / "test.csv", home / "test_images"


@contextmanager
def uncollected() -> Iterator[None]:
    """Garbage collection waits: while a million values are made and kept, it would search them over and over."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@uncollected()
def read_test_side(directory: Path) -> tuple[Pair, ...]:
    """The pairs of ``test.csv``, in its order.

    ``directory`` holds ``test.csv`` and ``test_images/``, or is ``test_images`` itself with ``test.csv``
    beside it. A missing image is no error here: its path does not exist. Raises
    :class:`UserError` for a missing or unreadable table, missing columns, no rows, sample ids that are repeated or
    have control characters, and other ids that are not plain names.
    """
    path, images = test_side(directory)
    table = read_table(path, TEST_COLUMNS)
    if not images.is_dir():
        raise UserError(f"{images}: no such directory; --test-dir must hold test.csv and test_images/")
    if table.empty:
        raise UserError(f"{path} has no rows: there is nothing to match")
    repeated = table["sample_id"][table["sample_id"].duplicated()]
    if not repeated.empty:
        times = int((table["sample_id"] == repeated.iloc[0]).sum())
        raise UserError(f"{path}: the sample_id {repeated.iloc[0]!r} occurs {times} times")
    if odd := next(filter(CONTROL.search, table["sample_id"]), None):
        raise UserError(f"{path}: the sample_id {odd!r} has control characters, which a submission cannot hold")
    for column in TEST_COLUMNS[1:]:
        for name in table[column].unique():
            plain_name(name, path)
    found = {batch: Images(images / batch) for batch in table["batch_id"].unique()}
    rows = (table[column].tolist() for column in TEST_COLUMNS)
    return tuple(
        Pair(sample, sys.intern(batch), found[batch][first], found[batch][second])
        for sample, batch, first, second in zip(*rows, strict=True)
    )


def read_train_side(
    directory: Path,
    *,
    scenes: Iterable[str] = (),
    min_covisibility: float = 0.1,
    pairs_per_scene: int | None = None,
) -> tuple[Scene, ...]:
    """The scenes of a train side (all, or those named), with the pairs of at least that covisibility.

    ``pairs_per_scene`` takes that many of a scene's pairs, evenly spread over its table. Raises
    :class:`UserError` for missing files, columns or scenes, and for cells that cannot be read.
    """
    factors = read_table(directory / "scaling_factors.csv", ("scene", "scaling_factor"))
    cells = zip(factors["scene"], factors["scaling_factor"], strict=True)
    metres = {scene: float(_numbers(cell, directory / "scaling_factors.csv", 1)[0]) for scene, cell in cells}
    wanted = list(scenes) or sorted(name for name in metres if (directory / name).is_dir())
    for name in wanted:
        if name not in metres:
            raise UserError(f"{directory}: unknown scene {name!r}; known: {', '.join(sorted(metres))}")
    if not wanted:
        raise UserError(f"{directory} has none of the scenes of its scaling_factors.csv")
    return tuple(
        _read_scene(directory / plain_name(name, directory), metres[name], min_covisibility, pairs_per_scene)
        for name in wanted
    )


def read_true_pair(directory: Path, pair: str) -> tuple[Scene, TruePair]:
    """The pair ``SCENE;IMAGE-IMAGE`` of a train side, whatever its covisibility, and its scene.

    Raises :class:`UserError` where there is none, besides what :func:`read_train_side` raises.
    """
    (scene,) = read_train_side(directory, scenes=[pair.partition(";")[0]], min_covisibility=0.0)
    known = {true.pair.id: true for true in scene.pairs}
    if pair not in known:
        raise UserError(f"{directory}: unknown pair {pair!r}; known: {', '.join(list(known)[:3])}, ...")
    return scene, known[pair]


def read_cameras(path: Path) -> dict[str, Camera]:
    """The cameras of a ``calibration.csv`` by image id."""
    columns = ("image_id", "camera_intrinsics", "rotation_matrix", "translation_vector")
    return {
        image: Camera(_numbers(K, path, 9).reshape(3, 3), _numbers(R, path, 9).reshape(3, 3), _numbers(t, path, 3))
        for image, K, R, t in read_table(path, columns)[list(columns)].itertuples(index=False)
    }


def write_submission(path: Path, rows: Mapping[str, Matrix3]) -> None:
    """Write ``sample_id,fundamental_matrix`` in the order of ``rows``; the file is replaced atomically.

    Raises ``OSError`` where it cannot be written; an earlier file is then unchanged.
    """
    with replacing(path) as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(SUBMISSION_COLUMNS)
        table.writerows(zip(rows, _cells(rows.values()), strict=True))


def _cells(matrices: Iterable[Matrix3]) -> Iterator[str]:
    """Each matrix as text; a matrix that follows itself, as the fallback does, is not formatted again."""
    last, text = None, ""
    for F in matrices:
        if F is not last:
            last, text = F, " ".join(f"{value:.12g}" for value in F.ravel())
        yield text


@contextmanager
def replacing(path: Path) -> Iterator[TextIO]:
    """A file to write, under a name of its own, that takes the place of ``path`` when all of it is on the disk.

    Raises ``OSError`` where it cannot be written; nothing is left of it then.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")  # two runs may have one output
    _parts.add(part)
    try:
        with part.open("x", encoding="utf-8", newline="") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
        _parts.discard(part)


def discard_parts() -> None:
    """Remove what this process has begun to write and not finished, before it is left at once."""
    for part in tuple(_parts):
        with suppress(OSError):
            part.unlink(missing_ok=True)


def read_submission(path: Path) -> dict[str, Matrix3]:
    """F by sample id; raises :class:`UserError` for a file that is no submission."""
    table = read_table(path, SUBMISSION_COLUMNS)
    cells = zip(table["sample_id"], table["fundamental_matrix"], strict=True)
    return {sample: _numbers(cell, path, 9).reshape(3, 3) for sample, cell in cells}


def submission_problems(path: Path, sample_ids: Sequence[str]) -> list[str]:
    """What is wrong with a submission, one sentence each; empty if the competition accepts it."""
    try:
        table = read_table(path, SUBMISSION_COLUMNS)
    except UserError as error:
        return [str(error)]
    problems = []
    if tuple(table.columns) != SUBMISSION_COLUMNS:
        problems.append(f"the header is {','.join(table.columns)}, not {','.join(SUBMISSION_COLUMNS)}")
    found = list(table["sample_id"])
    if found != list(sample_ids):
        problems.append(_difference(found, sample_ids))
    for sample, cell in zip(found, table["fundamental_matrix"], strict=True):
        try:
            F = _numbers(cell, path, 9)
        except UserError as error:
            problems.append(f"{sample}: {error}")
            continue
        if not np.isfinite(F).all():
            problems.append(f"{sample}: a number is not finite")
        elif not F.any():
            problems.append(f"{sample}: the matrix is zero")
    return problems


def read_table(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    """A CSV file with all cells as text; raises :class:`UserError` unless it has these columns."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a regular file")
    try:
        with path.open("rb") as stream:
            if stream.readline(1 << 20).count(b",") >= MOST_COLUMNS:
                raise ValueError(f"it has more than {MOST_COLUMNS} columns")
            stream.seek(0)
            if any(b"\0" in block for block in iter(partial(stream.read, 1 << 20), b"")):
                raise ValueError("it has NUL characters")  # some versions of pandas end the cell there
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except pd.errors.EmptyDataError as error:
        raise UserError(f"{path} is empty; expected the columns {', '.join(columns)}") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as a table: {error}") from error
    if not isinstance(table.index, pd.RangeIndex):  # pandas took the first column for an index
        raise UserError(f"{path} has rows with more cells than its header: {', '.join(table.columns)}")
    missing = [column for column in columns if column not in table.columns]
    if missing:
        raise UserError(f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(table.columns)}")
    return table


def plain_name(name: str, where: Path) -> str:
    """``name`` if it is the name of one file or directory; an id must not point outside its directory."""
    if NOT_PLAIN.search(name):
        raise UserError(f"{where}: the id {name!r} is not a plain name, so it cannot name a file here")
    return name


def pair_id(scene: str, first: str, second: str) -> str:
    """The id under which a pair of the train side runs."""
    return f"{scene};{first}-{second}"


def evenly_spread(items: Sequence[Item], most: int | None) -> list[Item]:
    """At most that many of the items, the first and the last among them."""
    if most is None or most >= len(items):
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, most).round().astype(int)]


class Images(dict[str, str]):
    """Paths of the images of a directory, as it is now, by id; for any other id a png that does not exist."""

    def __init__(self, directory: Path) -> None:
        self.directory = str(directory)
        try:
            images = sorted(path for path in directory.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
        except OSError:  # there is none, or none can have a name as long as that
            images = []
        super().__init__((path.stem, str(path)) for path in reversed(images))

    def __missing__(self, image_id: str) -> str:
        return f"{self.directory}{os.sep}{image_id}.png"


def _read_scene(directory: Path, metres: float, min_covisibility: float, most: int | None) -> Scene:
    cameras = read_cameras(directory / "calibration.csv")
    path, columns = directory / "pair_covisibility.csv", ["pair", "covisibility"]
    images, pairs = Images(directory / "images"), []
    for key, cell in read_table(path, columns)[columns].itertuples(index=False):
        covisibility = float(_numbers(cell, path, 1)[0])
        first, dash, second = key.partition("-")
        if not dash or first not in cameras or second not in cameras:
            raise UserError(f"{path}: the pair {key!r} is not two images of calibration.csv")
        if covisibility >= min_covisibility:
            image0, image1 = (images[plain_name(name, path)] for name in (first, second))
            pair = Pair(pair_id(directory.name, first, second), directory.name, image0, image1)
            pairs.append(TruePair(pair, cameras[first], cameras[second], covisibility))
    if not pairs:
        raise UserError(f"{path} has no pair with a covisibility of at least {min_covisibility:g}")
    return Scene(directory.name, metres, tuple(evenly_spread(pairs, most)))


def _numbers(cell: str, where: Path, count: int) -> NDArray[np.float64]:
    try:
        numbers = np.array([float(part) for part in cell.split()])
    except ValueError as error:
        raise UserError(f"{where}: {cell!r} is not a list of numbers") from error
    if numbers.size != count:
        raise UserError(f"{where}: expected {count} numbers, found {numbers.size}: {cell!r}")
    return numbers


def _difference(found: Sequence[str], expected: Sequence[str]) -> str:
    are, should_be = set(found), set(expected)
    missing = [sample for sample in expected if sample not in are]
    surplus = [sample for sample in found if sample not in should_be]
    if missing:
        return f"{len(missing)} samples are missing, the first is {missing[0]}"
    if surplus:
        return f"{len(surplus)} samples are not in test.csv, the first is {surplus[0]}"
    if len(found) != len(expected):
        return "a sample is there twice"
    return "the samples are not in the order of test.csv"
