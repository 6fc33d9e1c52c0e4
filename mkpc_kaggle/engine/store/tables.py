"""The tables of the store. Each is a dataclass, whose fields are the columns.

A fact of a result is described here and nowhere else: the engine has the dataclass, and reports
read the columns by SQL (:mod:`dataframes`). A change of a field changes :data:`SCHEMA`: increase
``STORE_FORMAT`` in :mod:`database` with it.
"""

import json
import sqlite3
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from math import isfinite
from secrets import token_hex
from types import NoneType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from mkpc_kaggle.engine.plan.budget import format_duration
from mkpc_kaggle.engine.store.json_values import as_json, from_json
from mkpc_kaggle.engine.store.scene_record import SceneRecord
from mkpc_kaggle.errors import printable
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.scene.models import SfmModel

T = TypeVar("T")


# Results, by key


@dataclass(frozen=True, eq=False)
class UnitPoints:
    """The points of a unit on a pair: counts, seconds, and the matches as ``data``."""

    key: str
    unit: str
    matches: int = 0
    keypoints: int = 0  # detected in the first view; 0 for a matcher without a detector
    # A job's decoding and clustering are shared by its units.
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    note: str = ""  # how the unit deviated from its settings, for example in precision
    regions: tuple[CriticalRegion, ...] = ()  # of both images, for a unit of stage 2
    # Of a unit of stage 2: whether the pair needs it, and the ratios of its ``CropNeed``
    is_needed: bool = True
    scale: float | None = None
    detail: float | None = None
    data: bytes = b""


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """The estimate of a pair: F, or E if the pair has intrinsics, and its statistics.

    ``inliers`` has a count for each key of points. ``F`` is the fallback if there is a ``failure``.
    ``magsac`` is MAGSAC's result before refinement, if any. The statistics are those of
    :class:`mkpc_kaggle.geometry.robust.EstimateStats`.
    """

    key: str
    inliers: dict[str, int] = field(default_factory=dict)
    F: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    failure: str = ""
    magsac: Matrix3 | None = None
    seconds: float = 0.0
    candidates: int = 0
    cost: float = 0.0
    magsac_cost: float = 0.0
    focal0: float = 0.0
    focal1: float = 0.0
    support: float = 0.0
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0)
    plane: float = 0.0


@dataclass(frozen=True, eq=False)
class Feature:
    """A feature of an image or of a folder: a JSON value, or ``data`` if the value is ``None``."""

    key: str
    value: Any = None
    data: bytes = b""


# Files


@dataclass(frozen=True)
class ImageFile:
    """The digest of an image file's ``content``, with the file's size in bytes and time of change in
    nanoseconds.
    """

    name: str
    content: str
    size: int
    changed: int

    @property
    def state(self) -> tuple[int, int]:
        return self.size, self.changed


@dataclass(frozen=True)
class ImageContent:
    """The facts about an image's content, by its digest. Files with equal contents share them."""

    content: str
    width: int
    height: int
    focal: float  # EXIF's, in pixels; 0 if unknown


@dataclass(frozen=True)
class Export:
    """A mark: the directory of a batch has the COLMAP files of the scene with this key."""

    batch: str
    scene: str


# The run


@dataclass(frozen=True)
class About:
    """Facts for reports about the last run that wrote the store."""

    # The table of a recipe's file, and the recipe's name
    recipe: dict[str, Any] = field(default_factory=dict)
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: Sequence[str] = ()  # matchers that did not run, by cause
    # Of the package and its main dependencies
    versions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PublishedRun:
    """The latest version of a run's results: one row, beside the rows of the pairs.

    The first ``rows`` of the ``pairs`` belong to the test set, the others are for scenes alone. Rows of
    the table of pairs after them are of an earlier run. ``units`` has names and stages, ``scenes`` the keys of
    the scenes in use by batch, and ``rivals`` those of the other candidates.
    """

    name: str = "run"
    about: About = field(default_factory=About)
    units: Sequence[Sequence[Any]] = ()
    rows: int = 0
    pairs: int = 0
    scenes: dict[str, str] = field(default_factory=dict)
    rivals: dict[str, list[str]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PublishedPair:
    """A pair as it was published last.

    ``points`` are the keys of its units' points, empty for a unit without points. ``F`` is the matrix that was
    written, F or E as ``model`` says, and ``source`` where it comes from: "scene", "pair" or "fallback"; empty for
    an extra pair. ``choice`` is the reason of the scene's choice, if there is a scene.

    ``failures`` are the reasons why units were given up, by unit; ``failure`` is why the pair has no points, and
    ``unestimated`` why it has points but no estimate, if not for lack of time.
    """

    number: int
    id: str
    batch: str
    image0: str
    image1: str
    turns0: int = 0
    turns1: int = 0
    contents: str = ""  # of both images, as in image_files.contents_of
    points: list[str] = field(default_factory=list)
    estimate: str = ""
    F: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    model: str = "F"
    source: str = "fallback"
    choice: str = ""
    failures: dict[str, str] = field(default_factory=dict)
    failure: str = ""
    unestimated: str = ""


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
    # Random, since several programs may write events of the same second to one store
    name: str = field(default_factory=lambda: token_hex(8), compare=False)

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


# How a dataclass is a table


@dataclass(frozen=True)
class Column:
    """A column, and the two directions of its conversion."""

    name: str
    declaration: str
    to_sql: Callable[[Any], Any]
    of_sql: Callable[[Any], Any]


@dataclass(frozen=True)
class Layout(Generic[T]):
    """The table of a dataclass. ``facts`` are all columns besides ``data``, if there is such a column."""

    kind: Callable[..., T]
    table: str
    key: str
    facts: tuple[Column, ...]
    has_data: bool

    @property
    def names(self) -> str:
        return ", ".join(column.name for column in self.facts)

    @property
    def sql(self) -> str:
        """The statement that creates the table.

        STRICT refuses values of a wrong type, which would be noticed only when a report is made.
        """
        lines = [
            f"{column.name} {column.declaration}{' PRIMARY KEY' * (column.name == self.key)}"
            for column in self.facts
        ]
        lines += ["data BLOB NOT NULL"] * self.has_data
        columns = ",\n    ".join([*lines, "checksum BLOB NOT NULL"])
        return f"CREATE TABLE {self.table} (\n    {columns}\n) STRICT"

    def values(self, row: T) -> tuple[Any, ...]:
        """Return the facts as SQLite has them. Raise ``sqlite3.IntegrityError`` for a number that is
        not finite.
        """
        try:
            return tuple(column.to_sql(getattr(row, column.name)) for column in self.facts)
        except ValueError as error:
            raise sqlite3.IntegrityError(f"{self.table}: {error}") from error

    def row(self, values: Sequence[Any]) -> T:
        """Return the row with these facts, without its data."""
        pairs = zip(self.facts, values, strict=True)
        return self.kind(**{column.name: column.of_sql(value) for column, value in pairs})


def _same(value: Any) -> Any:
    return value


def _finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError(f"{value} is no number")
    return float(value)  # also for NumPy's float32


def _dumps(value: Any) -> str:
    return printable(json.dumps(as_json(value), allow_nan=False))


# 16 characters a point; as decimal digits, the points would be most of a large store.
def _models_to_sql(models: Sequence[SfmModel]) -> str:
    return _dumps(
        [
            {
                "images": model.images,
                "points": b64encode(model.points.astype("<f4").tobytes()).decode("ascii"),
                "reprojection_error": float(model.reprojection_error),
                "comparison": model.comparison,
            }
            for model in models
        ]
    )


def _models_of_sql(text: str) -> tuple[SfmModel, ...]:
    models = []
    for about in json.loads(text):
        points = np.frombuffer(b64decode(about.pop("points")), "<f4").reshape(-1, 3)
        model: SfmModel = from_json(SfmModel, {**about, "points": []})
        models.append(replace(model, points=points.astype(np.float64)))
    return tuple(models)


PLAIN: dict[Any, tuple[str, Callable[[Any], Any], Callable[[Any], Any]]] = {
    str: ("TEXT", printable, _same),
    int: ("INTEGER", _same, _same),
    float: ("REAL", _finite, _same),
    bool: ("INTEGER", int, bool),
    tuple[SfmModel, ...]: ("TEXT", _models_to_sql, _models_of_sql),
}


def _column(name: str, hint: Any) -> Column:
    if NoneType in get_args(hint):
        (known,) = set(get_args(hint)) - {NoneType}
        column = _column(name, known)
        return Column(
            name,
            column.declaration.removesuffix(" NOT NULL"),
            lambda value: None if value is None else column.to_sql(value),
            lambda value: None if value is None else column.of_sql(value),
        )
    if hint in PLAIN:
        kind, to_sql, of_sql = PLAIN[hint]
        return Column(name, f"{kind} NOT NULL", to_sql, of_sql)
    if get_origin(hint) is np.ndarray:
        # A matrix of float64
        return Column(
            name,
            "BLOB NOT NULL",
            lambda matrix: np.asarray(matrix, "<f8").tobytes(),
            lambda data: np.frombuffer(data, "<f8").reshape(3, 3),
        )
    return Column(name, "TEXT NOT NULL", _dumps, lambda text: from_json(hint, json.loads(text)))


def _layout(kind: type[T], table: str, key: str) -> Layout[T]:
    hints = get_type_hints(kind)
    stored = [each for each in fields(kind) if each.metadata.get("is_stored", True)]  # type: ignore[arg-type]
    names = [each.name for each in stored]
    facts = tuple(_column(name, hints[name]) for name in names if name != "data")
    return Layout(kind, table, key, facts, "data" in names)


LAYOUTS: dict[Any, Layout[Any]] = {
    kind: _layout(kind, table, key)
    for kind, table, key in (
        (UnitPoints, "points", "key"),
        (PairEstimate, "estimate", "key"),
        (SceneRecord, "scene", "key"),
        (Feature, "feature", "key"),
        (ImageFile, "file", "name"),
        (ImageContent, "image", "content"),
        (Export, "export", "batch"),
        (PublishedRun, "run", "name"),
        (PublishedPair, "pair", "number"),
        (Event, "event", "name"),
    )
}
SCHEMA = ";\n".join(layout.sql for layout in LAYOUTS.values()) + ";"
# The results that a prune may remove. The other tables are small, or no pair names their rows.
PRUNED = (UnitPoints, PairEstimate, SceneRecord)
