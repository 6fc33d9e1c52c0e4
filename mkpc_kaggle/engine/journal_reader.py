"""The journal of a run, read at one moment: results by pair and batch, and events.

``schema.sql`` defines the tables, and views that decide which rows are current.
"""

import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruct import models_of
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

FORMAT = 15
FILE_NAME = "journal.sqlite"

NOT_REACHED = "not reached in time"
NO_CAMERAS = "no matches connect its images"
MAX_DRAWN_POINTS = 300  # per model, evenly chosen

# SQLite's primary result codes that do not mean damage: no permission, busy, locked, read only, input or output
# error, full, cannot be opened.
UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
# Errors when reading values that no run writes.
DAMAGE = (sqlite3.Error, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)

Value = TypeVar("Value")


class EventKind(StrEnum):
    """Kinds of events."""

    START = "start"  # the program began or resumed the run
    PLAN = "plan"  # a decision, with its reason
    SCENE = "scene"  # a batch was reconstructed; the text states its registered part
    FAULT = "fault"
    END = "end"  # the run ended; the text states the ending


@dataclass(frozen=True)
class Event:
    """An event ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


@dataclass(frozen=True)
class About:
    """Facts for reports about the last run that wrote the journal."""

    recipe: Mapping[str, Any] = field(default_factory=dict)  # the table of a recipe's file, and the recipe's name
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: Sequence[str] = ()  # matchers that did not run, by cause
    versions: Mapping[str, str] = field(default_factory=dict)  # of the package and its main dependencies


@dataclass(frozen=True, slots=True)
class UnitRecord:
    """Result of a unit on a pair: numbers of matches and of their inliers, and seconds."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str
    note: str = ""  # how the unit deviated from its settings, for example in precision
    keypoints: int = 0  # detected in the first view; 0 for a matcher without a detector


@dataclass(frozen=True, eq=False, slots=True)
class PairRecord:
    """The F of a pair (E if the pair has intrinsics), with its origin.

    ``pair_fundamental`` comes from the pair's own matches. If ``failure`` is not empty, it is the fallback.
    ``magsac_fundamental`` is MAGSAC's result before refinement, if any. ``scene`` is the choice by the batch's
    scene, ``None`` without a scene. Seconds belong to the current points and estimate.
    """

    index: int
    pair: Pair  # with image names in place of paths
    pair_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    failure: str = NOT_REACHED
    units: Sequence[UnitRecord] = ()
    regions: Regions | None = None
    matches: int = 0  # this and the next four fields: over all units
    decode_seconds: float = 0.0
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    scene: Choice | None = None
    magsac_fundamental: Matrix3 | None = None
    stats: EstimateStats = NO_STATS

    @property
    def inliers(self) -> int:
        return sum(unit.inliers for unit in self.units)

    @property
    def chosen_fundamental(self) -> Matrix3:
        """The F to write: the choice by the batch's scene, else the pair's own F."""
        return self.pair_fundamental if self.scene is None or self.scene.F is None else self.scene.F

    @property
    def source(self) -> str:
        """The source of :attr:`chosen_fundamental`: "scene", "pair" or "fallback"."""
        if self.scene is None or self.scene.F is None:
            return "fallback" if self.failure else "pair"
        return "scene" if self.scene.from_scene else "pair"

    @property
    def is_solved(self) -> bool:
        return self.source != "fallback"

    @property
    def overlaps(self) -> bool:
        """True if the two images probably overlap."""
        return self.stats.support >= MIN_SUPPORT

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images and points, and the models.

    The largest model comes first. Each model has up to ``MAX_DRAWN_POINTS`` of its points, evenly chosen. Without
    a model, ``failure`` is the reason.
    """

    batch: str
    images: int = 0
    registered: int = 0
    points: int = 0
    seconds: float = 0.0
    failure: str = ""
    models: tuple[SfmModel, ...] = field(default=(), compare=False)

    @classmethod
    def of(cls, batch: str, found: Sequence[Reconstruction], seconds: float = 0.0) -> "SceneRecord":
        models = models_of(found)
        reasons = dict.fromkeys(each.failure for each in found if each.failure)
        return cls(
            batch,
            sum(len(each.names) for each in found),
            sum(each.registered for each in found),
            sum(len(model.points) for model in models),
            seconds,
            "" if models else "; ".join(reasons) or NO_CAMERAS,
            tuple(replace(model, points=_evenly(model.points)) for model in models),
        )


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Convert errors in the block to a :class:`UserError` about a damaged or unusable journal."""
    try:
        yield
    except DAMAGE as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run using it?") from error
        raise UserError(f"{path} is damaged ({error}); {advice}") from error


class JournalReader:
    """A snapshot of the journal of a work directory, even while a run writes to the journal.

    All methods raise :class:`UserError` if the file is missing, damaged, or of another format. A position is the
    index of a pair among all pairs that the run asked for.
    """

    path: Path
    _db: sqlite3.Connection

    def __init__(self, directory: Path, *, check: bool = True) -> None:
        self.path = path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # SQLite cannot create its locks in a read-only directory, and needs none there.
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

    def about(self) -> About:
        return self._read(lambda row: About(**json.loads(row["value"])), "SELECT value FROM about")[0]

    def events(self) -> tuple[Event, ...]:
        """Return all events of all sessions, in order."""
        return tuple(self._read(partial(value_of, Event), "SELECT * FROM event ORDER BY number"))

    def records(self) -> list[PairRecord]:
        """Return the records of all pairs that have a row, in order."""
        units = self._by_pair(partial(value_of, UnitRecord), "unit_record")
        regions, choices = self._by_pair(_region, "region_record"), self.choices()

        def record(row: sqlite3.Row) -> PairRecord:
            at = row["index"]
            return _pair_record(row, units=units.get(at, ()), regions=regions.get(at), scene=choices.get(at))

        return self._read(record, 'SELECT * FROM pair_record ORDER BY "index"')

    def choices(self) -> dict[int, Choice]:
        """Return the choices of standing scenes, by the position of the pair."""
        return dict(self._read(_choice, "SELECT * FROM pair_choice"))

    def scenes(self, table: str = "standing_scene") -> dict[str, SceneRecord]:
        """Return the standing reconstruction of each batch, or each batch's latest row in another table."""
        scenes = self._read(self._scene, f"SELECT * FROM {table} ORDER BY batch, revision")
        return {scene.batch: scene for scene in scenes}

    def points(self, revisions: Iterable[int]) -> dict[int, Matches]:
        """Return the points of the rows with these revisions, by revision."""
        query = "SELECT points FROM points WHERE revision = ?"
        return {each: self._read(lambda row: from_blob(row["points"]), query, each)[0] for each in revisions}

    def inputs(self, position: int) -> dict[str, int]:
        """Return the revisions of a pair's current points by unit, in the recipe's order."""
        query = "SELECT unit, revision FROM current_points WHERE position = ? ORDER BY number"
        return dict(self._read(tuple, query, position))

    def images(self, position: int) -> tuple[BatchImage, ...]:
        """Return both images of a pair as last read, or an empty tuple if one is unknown."""
        query = "SELECT * FROM pair_image WHERE position = ? ORDER BY side"
        images = self._read(lambda row: value_of(BatchImage, row, size=value_of(Size, row)), query, position)
        return tuple(images) if len(images) == 2 else ()

    def feature(self, digest: str, settings: str) -> bytes | None:
        """Return the features saved under a key, or ``None``."""
        query = "SELECT value FROM feature WHERE digest = ? AND settings = ?"
        return next(iter(self._read(itemgetter(0), query, digest, settings)), None)

    def _scene(self, row: sqlite3.Row) -> SceneRecord:
        models = self._read(self._model, "SELECT * FROM model WHERE scene = ? ORDER BY number", row["revision"])
        return value_of(SceneRecord, row, models=tuple(models))

    def _model(self, row: sqlite3.Row) -> SfmModel:
        query = "SELECT * FROM camera WHERE scene = ? AND model = ? ORDER BY rowid"
        images = self._read(_registered, query, row["scene"], row["number"])
        return SfmModel(tuple(images), floats(row["points"], -1, 3), row["reprojection_error"])

    def _by_pair(self, make: Callable[[sqlite3.Row], Value], view: str) -> dict[int, tuple[Value, ...]]:
        """Return the values of each pair in the order of their numbers, by the pair's position."""
        query = f"SELECT * FROM {view} ORDER BY position, number"
        values = self._read(lambda row: (row["position"], make(row)), query)
        return {position: tuple(value for _, value in group) for position, group in groupby(values, itemgetter(0))}

    def _read(self, make: Callable[[sqlite3.Row], Value], query: str, *values: Any) -> list[Value]:
        """Return ``make(row)`` of each row. Raise :class:`UserError` if the journal is damaged or unusable."""
        with undamaged(self.path):
            return [make(row) for row in self._db.execute(query, values)]

    def _check(self) -> None:
        """Raise :class:`UserError` for a journal of another format, ``sqlite3.Error`` for a damaged journal."""
        if self._db.execute("PRAGMA user_version").fetchone()[0] != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not {FORMAT}). "
                "Use that version, delete it with --fresh, or name another --work-dir."
            )
        if (trouble := self._db.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
            raise sqlite3.DatabaseError(trouble)


def connected(path: Path | str, options: str = "", timeout: float = 1.0) -> sqlite3.Connection:
    """Return a connection with named columns, and without Python's implicit transactions.

    ``path`` is a file, or ":memory:". ``options`` are the options of the file's SQLite URI.
    """
    uri = f"{path.resolve().as_uri()}?{options}" if isinstance(path, Path) else f"file:{path}"
    db = sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None)
    db.row_factory = sqlite3.Row
    return db


def value_of(kind: type[Value], row: sqlite3.Row, **more: Any) -> Value:
    """Return a dataclass or named tuple whose fields are the columns of the same names; ``more`` are other fields.

    If a column is NULL, its field has the default value.
    """
    names = kind.__annotations__.keys() & row.keys() - more.keys()
    return kind(**{name: row[name] for name in names if row[name] is not None}, **more)


def _pair_record(row: sqlite3.Row, **more: Any) -> PairRecord:
    if row["F"] is not None:
        focals, rotation = (tuple(map(float, row[name].split())) for name in ("focals", "rotation"))
        more["stats"] = value_of(EstimateStats, row, focals=focals, rotation=rotation)
        more["pair_fundamental"] = matrix_of(row["F"])
        more["magsac_fundamental"] = row["magsac"] and matrix_of(row["magsac"])
    pair = Pair(row["id"], row["batch"], row["image0"], row["image1"], turns=(row["turns0"], row["turns1"]))
    return value_of(PairRecord, row, pair=pair, **more)


def _region(row: sqlite3.Row) -> CriticalRegion:
    return value_of(CriticalRegion, row, box=value_of(Box, row), reason=RegionReason(row["reason"]))


def _choice(row: sqlite3.Row) -> tuple[int, Choice]:
    return row["position"], Choice(row["F"] and matrix_of(row["F"]), Reason(row["reason"]))


def _registered(row: sqlite3.Row) -> RegisteredImage:
    image = BatchImage(row["name"], row["digest"], value_of(Size, row))
    camera = Camera(floats(row["K"], 3, 3), floats(row["R"], 3, 3), floats(row["t"], 3))
    return RegisteredImage(image, camera, row["points"], () if row["centre"] is None else value_of(Sigmas, row))


def _evenly(points: NDArray[np.float64]) -> NDArray[np.float64]:
    chosen = np.linspace(0, len(points) - 1, min(MAX_DRAWN_POINTS, len(points))).round().astype(int)
    return np.asarray(points[chosen])


def to_blob(matches: Matches) -> bytes:
    """Return the bytes of x0, y0, x1, y1 and score of each match, as little-endian float32."""
    return np.column_stack([matches.points0, matches.points1, matches.scores]).astype("<f4").tobytes()


def from_blob(blob: bytes) -> Matches:
    """Invert :func:`to_blob`. Raise ``ValueError`` for damaged bytes."""
    table = np.frombuffer(blob, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])


def matrix_of(blob: bytes) -> Matrix3:
    """Return the matrix stored in 72 bytes. Raise ``ValueError`` if it is zero or not finite."""
    matrix = floats(blob, 3, 3)
    if not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero or not finite")
    return matrix


def floats(blob: bytes, *shape: int) -> NDArray[np.float64]:
    return np.frombuffer(blob).reshape(shape).copy()
