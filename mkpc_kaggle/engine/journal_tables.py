"""The tables of a run's journal, an SQLite file, and how they are read.

Tables: ``run`` (what the journal belongs to and who wrote it), ``sample`` (the ids of the pairs), ``pair`` (F,
failure, seconds, what tells the contents of its images, MAGSAC's F alone), ``unit``
(counts and seconds of each unit on each pair, and its points while a later pass may build on them or the report
may draw them), ``region`` (the critical regions), ``choice`` (which F the reconstruction of its batch gives a
pair, and why), ``scene`` (what came of each batch), ``event`` (what happened when).
"""

import json
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import wraps
from math import isfinite
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.records import CameraRecord, PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice, Reason

FORMAT = 6
FILE_NAME = "journal.sqlite"
LOCK_NAME = "journal.lock"
MOST_POINT_BYTES = 1 << 26
"""Of one unit on one pair: three million matches; a damaged journal may promise more."""
DRAWN = 10
"""How many of the weakest pairs keep their points when no later pass needs them: the report draws them."""

UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
"""SQLite's primary result codes that say nothing against a file: no permission, busy, locked, read only, input or
output failed, full, cannot be opened."""

Tables = TypeVar("Tables", bound="JournalTables")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Row = TypeVar("Row")

SCHEMA = """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE sample (
    pair INTEGER PRIMARY KEY, id TEXT NOT NULL, "group" TEXT NOT NULL, image0 TEXT NOT NULL, image1 TEXT NOT NULL);
CREATE TABLE pair (
    pair INTEGER PRIMARY KEY, fundamental BLOB NOT NULL, failure TEXT NOT NULL,
    decode_seconds REAL, cluster_seconds REAL, estimate_seconds REAL,
    version0 TEXT NOT NULL, version1 TEXT NOT NULL,
    width0 INTEGER, height0 INTEGER, width1 INTEGER, height1 INTEGER, magsac BLOB);
CREATE TABLE unit (
    pair INTEGER, unit TEXT, stage INTEGER, matches INTEGER, inliers INTEGER,
    encode_seconds REAL, match_seconds REAL, failure TEXT, place INTEGER, points BLOB,
    PRIMARY KEY (pair, unit));
CREATE TABLE region (
    pair INTEGER, image INTEGER, "left" INTEGER, top INTEGER, "right" INTEGER, bottom INTEGER,
    reason TEXT, clusters INTEGER, kept INTEGER, PRIMARY KEY (pair, image));
CREATE TABLE choice (pair INTEGER PRIMARY KEY, fundamental BLOB, reason TEXT NOT NULL);
CREATE TABLE scene (
    batch TEXT PRIMARY KEY, images INTEGER, placed INTEGER, models INTEGER, points INTEGER, made_from INTEGER,
    seconds REAL, failure TEXT NOT NULL, cameras TEXT NOT NULL, cloud TEXT NOT NULL);
CREATE TABLE event (place INTEGER PRIMARY KEY, kind TEXT, seconds REAL, text TEXT);
"""


class EventKind(StrEnum):
    """What is noted during a run."""

    START = "start"
    """the program began to work on the run, anew or once more"""
    PLAN = "plan"
    """units were given up or taken up again, and why"""
    BUDGET = "budget"
    """a job of the phase that the text names has ended"""
    JOB = "job"
    """what that job was"""
    SCENE = "scene"
    """a batch was reconstructed; the text says how much of it"""
    FAULT = "fault"
    END = "end"
    """the run ended; the text says how"""


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str


@dataclass(frozen=True)
class About:
    """Who wrote a journal last: for reports, and compared with nothing.

    ``limit`` is the time limit in seconds, ``None`` if there was none; ``left_out`` says which matchers
    did not run, by cause; ``versions`` are those of the package and what it stands on.
    """

    recipe: str = "unnamed"
    device: str = ""
    limit: float | None = None
    left_out: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


@contextmanager
def undamaged(path: Path) -> Iterator[None]:
    """Raises :class:`UserError` where what is read of a journal is not what was written, or cannot be read now."""
    try:
        yield
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run at work there?") from error
        raise UserError(f"{path} is damaged ({error}); start anew with --fresh") from error
    except (
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        OverflowError,
        RecursionError,
        zlib.error,
    ) as error:
        raise UserError(f"{path} is damaged ({error}); start anew with --fresh") from error


def reading(
    method: Callable[Concatenate[Tables, Arguments], Result],
) -> Callable[Concatenate[Tables, Arguments], Result]:
    """A method that reads a journal under :func:`undamaged`."""

    @wraps(method)
    def read(tables: Tables, /, *arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        with undamaged(tables.path):
            return method(tables, *arguments, **options)

    return read


class JournalTables:
    """The reading side of an open journal."""

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        self.path = path
        self._db = db

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @reading
    def records(self) -> dict[int, PairRecord]:
        """All records by pair index."""
        units: dict[int, list[UnitRecord]] = {}
        columns = "pair, unit, stage, matches, inliers, encode_seconds, match_seconds, failure"
        for pair, *values in self._db.execute(f"SELECT {columns} FROM unit ORDER BY pair, place"):
            units.setdefault(pair, []).append(row_of(UnitRecord, values))
        regions: dict[int, list[CriticalRegion]] = {}
        columns = 'pair, "left", top, "right", bottom, reason, clusters, kept'
        for pair, left, top, right, bottom, reason, *counts in self._db.execute(
            f"SELECT {columns} FROM region ORDER BY pair, image"
        ):
            region = CriticalRegion(Box(left, top, right, bottom), RegionReason(reason), *counts)
            regions.setdefault(pair, []).append(region)
        choices = {
            pair: Choice(optional_matrix_of(F), Reason(reason))
            for pair, F, reason in self._db.execute("SELECT pair, fundamental, reason FROM choice")
        }
        columns = "failure, decode_seconds, cluster_seconds, estimate_seconds, version0, version1"
        found = {}
        sides = "width0, height0, width1, height1, magsac"
        rows = self._db.execute(f"SELECT pair, fundamental, {columns}, {sides} FROM pair")
        for pair, F, *values, width0, height0, width1, height1, magsac in rows:
            failure, decode, cluster, estimate, *versions = typed(values, (str, float, float, float, str, str))
            sizes = (Size(width0, height0), Size(width1, height1)) if width0 else ()
            typed([side for size in sizes for side in size], (int,) * 2 * len(sizes))
            found[pair] = PairRecord(
                pair,
                matrix_of(F),
                failure,
                tuple(units.get(pair, ())),
                (regions[pair][0], regions[pair][1]) if pair in regions else None,
                decode,
                cluster,
                estimate,
                choices.get(pair),
                sizes,
                tuple(filter(None, versions)),
                optional_matrix_of(magsac),
            )
        return found

    @reading
    def scenes(self) -> tuple[SceneRecord, ...]:
        """What came of each batch that was reconstructed, by name."""
        columns = "batch, images, placed, models, points, made_from, seconds, failure"
        rows = self._db.execute(f"SELECT {columns}, cameras, cloud FROM scene ORDER BY batch")
        found = []
        for *values, cameras, cloud in rows:
            known, points = [CameraRecord(**camera) for camera in json.loads(cameras)], json.loads(cloud)
            for camera in known:
                numbers = (*camera.centre, *camera.forward, *camera.down)
                numbers += (camera.focal, *camera.size, camera.model, camera.seen)
                typed(numbers, (float,) * 10 + (int,) * 4)
            for point in points:
                typed(point, (float,) * 3)
            found.append(replace(row_of(SceneRecord, values), cameras=tuple(known), cloud=tuple(points)))
        return tuple(found)

    @reading
    def results(self, pair: int, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        """What the units found on a pair, for a later job to build on; ``units`` by name."""
        columns = "unit, points, encode_seconds, match_seconds, failure"
        return tuple(
            UnitResult(units[name], from_blob(points), encode, match, failure)
            for name, points, encode, match, failure in self._db.execute(
                f"SELECT {columns} FROM unit WHERE pair = ? ORDER BY place", [pair]
            )
        )


class JournalReader(JournalTables):
    """The journal of a work directory as it is now, unchanged while it is read; a run may be at work on it.

    Raises :class:`UserError` where there is none, or none that this version can read.
    """

    def __init__(self, directory: Path) -> None:
        path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # A directory that cannot be written has no room for SQLite's locks, and needs none.
        mode = "mode=ro" if os.access(directory, os.W_OK) else "mode=ro&immutable=1"
        with ExitStack() as opened, undamaged(path):
            uri = f"{path.resolve().as_uri()}?{mode}"
            db = opened.enter_context(closing(sqlite3.connect(uri, uri=True, timeout=5.0, isolation_level=None)))
            db.execute("BEGIN")
            require_format(path, header_of(db))
            opened.pop_all()
        super().__init__(path, db)

    @reading
    def belongs_to(self) -> dict[str, Any]:
        """What the run computes, by name: the recipe's fingerprint, digests of the test set and the weights."""
        return {key: value for key, value in header_of(self._db).items() if key not in ("format", "about")}

    @reading
    def about(self) -> About:
        values = header_of(self._db).get("about", {})
        about = About(**{**values, "left_out": tuple(values.get("left_out", ()))})
        names = (about.recipe, about.device, *about.left_out, *dict(about.versions).values())
        typed((*names, about.limit or 0.0), (str,) * len(names) + (float,))
        return about

    @reading
    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of the run, in order; of the images the journal knows the names of the files alone."""
        rows = self._db.execute('SELECT id, "group", image0, image1 FROM sample ORDER BY pair')
        return tuple(row_of(Pair, row) for row in rows)

    @reading
    def events(self) -> tuple[Event, ...]:
        """All events of all sessions of the run, in order."""
        return tuple(
            row_of(Event, row) for row in self._db.execute("SELECT kind, seconds, text FROM event ORDER BY place")
        )


def require_format(path: Path, header: Mapping[str, Any]) -> None:
    """Raise :class:`UserError` unless the journal was written in this version's format."""
    written = header.get("format")
    if written != FORMAT:
        raise UserError(
            f"{path} was written by another version of this program (journal format {written}, this version has "
            f"{FORMAT}). Use that version, or start anew with --fresh or another --work-dir."
        )


def header_of(db: sqlite3.Connection) -> dict[str, Any]:
    """The table ``run``; empty where the journal is new."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'run'").fetchone():
        return {}
    return {key: json.loads(value) for key, value in db.execute("SELECT key, value FROM run")}


def connect(path: Path) -> sqlite3.Connection:
    """Open a database to write; raises :class:`UserError` where that cannot be."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a regular file; remove it, or name another --work-dir")
    with undamaged(path):
        return sqlite3.connect(path, timeout=1.0, isolation_level=None)


def typed(values: Sequence[Any], kinds: Sequence[Any]) -> Sequence[Any]:
    """The values, if each is of its kind; ``ValueError`` if not, since SQLite takes any into any column."""
    for value, kind in zip(values, kinds, strict=True):
        if type(value) is not kind or (kind is float and not isfinite(value)):
            raise ValueError(f"{value!r} is no {kind.__name__}")
    return values


def row_of(cls: type[Row], values: Sequence[Any]) -> Row:
    """The first fields of a dataclass from a row, each of its kind."""
    return cls(*typed(values, [*cls.__annotations__.values()][: len(values)]))


def matrix_of(blob: bytes) -> Matrix3:
    """F from its bytes; ``ValueError`` for one that no submission may have."""
    matrix = np.frombuffer(blob, np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero or not finite")
    return matrix


def optional_matrix_of(blob: bytes | None) -> Matrix3 | None:
    return None if blob is None else matrix_of(blob)


def to_blob(matches: Matches) -> bytes:
    """All float32 values, column by column, first bytes first: those of like size are alike, and deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def from_blob(blob: bytes | None) -> Matches:
    stream = zlib.decompressobj()
    data = stream.decompress(blob, MOST_POINT_BYTES) if blob else b""
    if blob and not stream.eof:
        raise ValueError("points are cut off, or more than there can be")
    planes = np.frombuffer(data, np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])
