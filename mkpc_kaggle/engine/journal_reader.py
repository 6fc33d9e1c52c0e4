"""Reading the journal of a run: its rows as values, at one moment.

``schema.sql`` has the tables, and in its views the rule that says which rows are current.
"""

import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.records import NOT_REACHED, PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import EstimateStats
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

FORMAT = 14
FILE_NAME = "journal.sqlite"

# SQLite's primary result codes that say nothing against a file: no permission, busy, locked, read only, input or
# output failed, full, cannot be opened.
UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
# Errors of reading what no run writes.
DAMAGE = (sqlite3.Error, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)

SUMS = ("matches", "inliers", "decode_seconds", "encode_seconds", "match_seconds", "cluster_seconds")
Method = TypeVar("Method", bound=Callable[..., Any])
Value = TypeVar("Value")


class EventKind(StrEnum):
    """Kinds of events."""

    START = "start"  # the program began or resumed the run
    PLAN = "plan"  # a decision, and why
    SCENE = "scene"  # a batch was reconstructed; the text says how much of it
    FAULT = "fault"
    END = "end"  # the run ended; the text says how


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


@dataclass(frozen=True)
class About:
    """The latest run that wrote a journal, for reports."""

    recipe: Mapping[str, Any] = field(default_factory=dict)  # a table as of a recipe's file, and its name
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: tuple[str, ...] = ()  # matchers that did not run, by cause
    versions: Mapping[str, str] = field(default_factory=dict)  # of the package and its main dependencies


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Raise :class:`UserError` if a journal is damaged or cannot be used now."""
    try:
        yield
    except DAMAGE as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run using it?") from error
        raise UserError(f"{path} is damaged ({error}); {advice}") from error


def reading(read: Method) -> Method:
    """Let a method raise :class:`UserError` if the journal that it reads is damaged or unusable."""

    @wraps(read)
    def checked(self: Any, *args: Any) -> Any:
        with undamaged(self.path):
            return read(self, *args)

    return cast(Method, checked)


class JournalReader:
    """The journal of a work directory at one moment; a run may be writing to it meanwhile.

    All methods raise :class:`UserError` if the file is missing, damaged, or of another format. A position is the
    index of a pair among all pairs that the run asked for.
    """

    path: Path
    _db: sqlite3.Connection

    def __init__(self, directory: Path, *, check: bool = True) -> None:
        self.path = path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # A directory that cannot be written has no room for SQLite's locks, and needs none.
        mode = "mode=ro" if os.access(directory, os.W_OK) else "mode=ro&immutable=1"
        with ExitStack() as opened, undamaged(path):
            self._db = opened.enter_context(closing(connected(path, mode, timeout=5.0)))
            self._db.execute("BEGIN")
            if check:
                self._check()
            opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()

    @reading
    def about(self) -> About:
        values = json.loads(self._rows("SELECT value FROM about")[0]["value"])
        return About(**{**values, "left_out": tuple(values["left_out"])})

    @reading
    def events(self) -> tuple[Event, ...]:
        """Return all events of all sessions, in order."""
        return tuple(Event(*row) for row in self._rows("SELECT kind, seconds, text FROM event ORDER BY number"))

    @reading
    def pairs(self) -> tuple[Pair, ...]:
        """Return the pairs that have a row, in order, with the names of their images for files."""
        query = """SELECT w.id, batch, image0, image1, turns0, turns1 FROM wanted_pair w
            JOIN pair ON pair.id = w.pair WHERE has_row ORDER BY position"""
        return tuple(Pair(n, b, f0, f1, turns=(t0, t1)) for n, b, f0, f1, t0, t1 in self._rows(query))

    @reading
    def records(self) -> list[PairRecord]:
        """Return a record of each pair that has a row, in order."""
        pairs = self._rows("SELECT failure, has_row FROM wanted_pair ORDER BY position")
        values: list[dict[str, Any]] = [{"failure": pair["failure"] or NOT_REACHED} for pair in pairs]
        inliers: dict[int, int] = {}
        for row in self._rows("SELECT * FROM standing_estimate"):
            inliers |= zip(map(int, row["inputs"].split()), map(int, row["inliers"].split()), strict=True)
            focals, rotation = (tuple(map(float, row[name].split())) for name in ("focals", "rotation"))
            values[row["position"]] |= {
                "pair_fundamental": matrix_of(row["F"]),
                "magsac_fundamental": None if row["magsac"] is None else matrix_of(row["magsac"]),
                "failure": row["failure"],
                "estimate_seconds": row["seconds"],
                "stats": value_of(EstimateStats, row, focals=focals, rotation=rotation),
            }
        for row in self._rows("SELECT * FROM unit_result ORDER BY position, number"):
            found, counts = values[row["position"]], dict(row) | {"inliers": inliers.get(row["revision"], 0)}
            found.setdefault("units", []).append(value_of(UnitRecord, counts))
            found |= {name: found.get(name, 0) + counts[name] for name in SUMS}
        # The regions of the first unit of stage 2 come last.
        for row in self._rows("SELECT * FROM region_result ORDER BY position, number DESC, image"):
            found, reason = values[row["position"]], RegionReason(row["reason"])
            region = value_of(CriticalRegion, row, box=value_of(Box, row), reason=reason)
            found["regions"] = (region,) if row["image"] == 0 else (*found["regions"], region)
        choices = self.choices()
        rows = range(sum(pair["has_row"] for pair in pairs))
        return [PairRecord(position, scene=choices.get(position), **values[position]) for position in rows]

    @reading
    def choices(self) -> dict[int, Choice]:
        """Return the choices of the standing scenes by the positions of their pairs."""
        return {
            position: Choice(None if F is None else matrix_of(F), Reason(reason))
            for position, F, reason in self._rows("SELECT position, F, reason FROM pair_choice")
        }

    @reading
    def scenes(self, table: str = "standing_scene") -> dict[str, SceneRecord]:
        """Return the standing reconstruction of each batch, or its latest row in another table."""
        scenes = {}
        for scene in self._rows(f"SELECT * FROM {table} ORDER BY batch, revision"):
            models = self._rows("SELECT * FROM model WHERE scene = ? ORDER BY number", scene["revision"])
            scenes[scene["batch"]] = value_of(SceneRecord, scene, models=tuple(map(self._model, models)))
        return scenes

    @reading
    def points(self, revisions: Iterable[int]) -> dict[int, Matches]:
        """Return the points of these rows, by revision."""
        query = "SELECT points FROM points WHERE revision = ?"
        return {revision: from_blob(self._rows(query, revision)[0]["points"]) for revision in revisions}

    @reading
    def inputs(self, position: int) -> dict[str, int]:
        """Return the revisions of a pair's current points by unit, in the recipe's order."""
        query = "SELECT unit, revision FROM current_points WHERE position = ? ORDER BY number"
        return dict(map(tuple, self._rows(query, position)))

    @reading
    def images(self, position: int) -> tuple[BatchImage, ...]:
        """Return both images of a pair as they were last looked at, or nothing."""
        rows = self._rows("SELECT * FROM pair_image WHERE position = ? ORDER BY side", position)
        images = tuple(value_of(BatchImage, row, size=value_of(Size, row)) for row in rows)
        return images if len(images) == 2 else ()

    @reading
    def feature(self, digest: str, settings: str) -> bytes | None:
        """Return the features saved under a key, or ``None``."""
        found = self._rows("SELECT value FROM feature WHERE digest = ? AND settings = ?", digest, settings)
        return found[0]["value"] if found else None

    def _model(self, row: sqlite3.Row) -> SfmModel:
        query = "SELECT * FROM camera WHERE scene = ? AND model = ? ORDER BY rowid"
        images = []
        for each in self._rows(query, row["scene"], row["number"]):
            image = BatchImage(each["name"], each["digest"], value_of(Size, each))
            camera = Camera(floats(each["K"], 3, 3), floats(each["R"], 3, 3), floats(each["t"], 3))
            sigmas = value_of(Sigmas, each)
            images.append(RegisteredImage(image, camera, each["points"], () if None in sigmas else sigmas))
        return SfmModel(tuple(images), floats(row["points"], -1, 3), row["reprojection_error"])

    def _rows(self, query: str, *values: Any) -> list[sqlite3.Row]:
        return self._db.execute(query, values).fetchall()

    def _check(self) -> None:
        """Raise :class:`UserError` for a journal of another format, ``sqlite3.Error`` for a damaged journal."""
        if self._rows("PRAGMA user_version")[0][0] != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not {FORMAT}). "
                "Use that version, delete it with --fresh, or name another --work-dir."
            )
        if (trouble := self._rows("PRAGMA quick_check(1)")[0][0]) != "ok":
            raise sqlite3.DatabaseError(trouble)


def connected(path: Path | str, options: str = "", timeout: float = 1.0) -> sqlite3.Connection:
    """Return a connection whose rows have names, without transactions of Python's own.

    ``path`` is a file, opened with ``options`` of an SQLite URI, or ":memory:".
    """
    uri = f"{path.resolve().as_uri()}?{options}" if isinstance(path, Path) else f"file:{path}"
    db = sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None)
    db.row_factory = sqlite3.Row
    return db


def value_of(kind: type[Value], row: sqlite3.Row | dict[str, Any], **more: Any) -> Value:
    """Return a dataclass or named tuple from columns with the names of its fields; ``more`` are other fields."""
    return kind(**{name: row[name] for name in kind.__annotations__ if name not in more}, **more)


def to_blob(matches: Matches) -> bytes:
    """Return x0, y0, x1, y1 and the score of each match, as little-endian float32."""
    return np.column_stack([matches.points0, matches.points1, matches.scores]).astype("<f4").tobytes()


def from_blob(blob: bytes) -> Matches:
    """Invert :func:`to_blob`. Raise ``ValueError`` for damaged bytes."""
    table = np.frombuffer(blob, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])


def matrix_of(blob: bytes) -> Matrix3:
    """Return F from its 72 bytes. Raise ``ValueError`` unless a submission may hold it."""
    matrix = floats(blob, 3, 3)
    if not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero or not finite")
    return matrix


def floats(blob: bytes, *shape: int) -> NDArray[np.float64]:
    return np.frombuffer(blob).reshape(shape).copy()
