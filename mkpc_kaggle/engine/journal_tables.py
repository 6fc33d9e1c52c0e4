"""The tables of a run's journal, an SQLite file, and how they are read.

A value is a JSON text: the fields of a dataclass in their order, matrices row by row. Tables: ``run`` (what the
journal belongs to and who wrote it), ``sample`` (ids and images of the pairs), ``pair`` (a :class:`PairRecord` for
each pair that was reached), ``points`` (of a unit on a pair, while a later job may build on them or the report may
draw them), ``scene`` (a :class:`SceneRecord` for each batch), ``event`` (what happened when).
"""

import json
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import astuple, dataclass, field, is_dataclass
from enum import StrEnum
from functools import cache, partial
from math import isfinite
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Self, get_args, get_origin, get_type_hints

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import printable
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit

FORMAT = 6
FILE_NAME = "journal.sqlite"
LOCK_NAME = "journal.lock"
MAX_POINT_BYTES = 1 << 26  # of a unit on a pair: three million matches; a damaged journal may promise more
DRAWN = 20  # how many of the weakest pairs keep their points when no later job needs them: the report draws them

SCHEMA = """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE sample (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE pair (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE points (pair INTEGER, unit TEXT, points BLOB NOT NULL, PRIMARY KEY (pair, unit));
CREATE TABLE scene (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE event (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
"""

# SQLite's primary result codes that say nothing against a file: no permission, busy, locked, read only, input or
# output failed, full, cannot be opened.
UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
# What reading raises where something stands that no run writes.
DAMAGE = (sqlite3.Error, zlib.error, ValueError, TypeError, LookupError, AttributeError, ArithmeticError)


class EventKind(StrEnum):
    """What is noted during a run."""

    START = "start"  # the program began to work on the run, anew or once more
    PLAN = "plan"  # a decision, and why
    JOB = "job"  # a job has ended; the text begins with its phase
    SCENE = "scene"  # a batch was reconstructed; the text says how much of it
    FAULT = "fault"
    END = "end"  # the run ended; the text says how


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str


@dataclass(frozen=True)
class About:
    """Who wrote a journal last: for reports, and compared with nothing."""

    recipe: str = "unnamed"
    device: str = ""
    limit: float | None = None  # in seconds; None: there was none
    left_out: tuple[str, ...] = ()  # which matchers did not run, by cause
    versions: Mapping[str, str] = field(default_factory=dict)  # of the package and what it stands on


@contextmanager
def undamaged(path: Path, advice: str = "start anew with --fresh") -> Iterator[None]:
    """Raises :class:`UserError` where what is read of a journal is not what was written, or cannot be read now."""
    try:
        yield
    except (*DAMAGE, RecursionError) as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run at work there?") from error
        raise UserError(f"{path} is damaged ({error}); {advice}") from error


class JournalTables:
    """The reading side of an open journal; what is damaged raises :class:`UserError`."""

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        self.path = path
        self._db = db

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()

    def records(self) -> dict[int, PairRecord]:
        """All records by pair index."""
        return {record.index: record for record in self._read("pair", PairRecord)}

    def scenes(self) -> tuple[SceneRecord, ...]:
        """What came of each batch that was reconstructed, by name."""
        return tuple(self._read("scene", SceneRecord))

    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of the run, in order; of the images the journal knows the names of the files alone."""
        return tuple(Pair(*names) for names in self._read("sample", tuple[str, str, str, str]))

    def events(self) -> tuple[Event, ...]:
        """All events of all sessions of the run, in order."""
        return tuple(self._read("event", Event))

    def about(self) -> About:
        with undamaged(self.path):
            about: About = decoder(About)(self._header()["about"])
            return about

    def belongs_to(self) -> dict[str, Any]:
        """What the run computes, by name: the recipe's fingerprint, digests of the test set and the weights."""
        return {key: value for key, value in self._header().items() if key not in ("format", "about")}

    def results(self, record: PairRecord, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        """What the units of a record found, for a later job to build on; ``units`` by name."""
        with undamaged(self.path):
            points = self._points(record.index)
            return tuple(
                UnitResult(
                    units[found.unit],
                    from_blob(points.get(found.unit)),
                    found.encode_seconds,
                    found.match_seconds,
                    found.failure,
                )
                for found in record.units
            )

    def _points(self, index: int) -> dict[str, bytes]:
        return dict(self._db.execute("SELECT unit, points FROM points WHERE pair = ?", [index]))

    def _read(self, table: str, kind: Any) -> list[Any]:
        with undamaged(self.path):
            decode = decoder(kind)
            rows = self._db.execute(f"SELECT value FROM {table} ORDER BY key")
            return [decode(json.loads(value)) for (value,) in rows]

    def _header(self) -> dict[str, Any]:
        """The table ``run``; raises :class:`UserError` where another version wrote it."""
        with undamaged(self.path):
            header = {key: json.loads(value) for key, value in self._db.execute("SELECT key, value FROM run")}
        if (written := header.get("format")) != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (journal format {written}, this "
                f"version has {FORMAT}). Use that version, or start anew with --fresh or another --work-dir."
            )
        return header


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
            super().__init__(path, db)
            self._header()
            opened.pop_all()


def encode(value: Any) -> str:
    """The JSON text of a value."""
    values = astuple(value) if is_dataclass(value) and not isinstance(value, type) else value
    return json.dumps(values, default=lambda array: array.tolist())


@cache
def decoder(kind: Any) -> Callable[[Any], Any]:
    """A function that makes a value of the type ``kind`` of its JSON, and raises where it is of another type."""
    if isinstance(kind, type) and issubclass(kind, (int, float, str)):
        return partial(scalar, kind)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return matrix_of
    hints = arguments or get_type_hints(kind).values()
    parts = [decoder(hint) for hint in hints if hint not in (NoneType, ...)]
    if origin is UnionType:  # with None
        return lambda value: None if value is None else parts[0](value)
    if origin is Mapping:
        return lambda table: {parts[0](key): parts[1](value) for key, value in table.items()}
    if ... in arguments:
        return lambda values: tuple(map(parts[0], values))
    make = (lambda *values: values) if origin is tuple else kind
    return lambda values: make(*(part(value) for part, value in zip(parts, values, strict=True)))


def scalar(kind: type, value: Any) -> Any:
    """A number, a text or a member of an enum."""
    if issubclass(kind, StrEnum):
        return kind(value)
    if kind is float and type(value) in (int, float) and isfinite(value):
        return float(value)
    if kind is float or type(value) is not kind:
        raise ValueError(f"{value!r} is not of type {kind.__name__}")
    return printable(value) if isinstance(value, str) else value


def matrix_of(rows: Any) -> Matrix3:
    """F from its rows; ``ValueError`` for one that no submission may have."""
    matrix = np.array(rows, np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero, not finite, or not of 3 x 3 numbers")
    return matrix


def to_blob(matches: Matches) -> bytes:
    """All float32 values, column by column, first bytes first: those of like size are alike, and deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def from_blob(blob: bytes | None) -> Matches:
    if blob is None:
        return Matches.empty()
    stream = zlib.decompressobj()
    data = stream.decompress(blob, MAX_POINT_BYTES)
    if not stream.eof:
        raise ValueError("points are cut off, or more than there can be")
    planes = np.frombuffer(data, np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])
