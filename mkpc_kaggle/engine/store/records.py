"""Records of a run, for reports: pairs, units, scenes and events.

The table of pairs is the latest version of the results. It names the results of each pair and has
the F to write. Nothing else decides which results reports show. If the files of that version could
not be written, an event states why.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Estimated
from mkpc_kaggle.engine.plan.budget import format_duration
from mkpc_kaggle.engine.store import codec
from mkpc_kaggle.engine.store.codec import FLOAT, PLAIN, by_name, optional, record, several
from mkpc_kaggle.engine.store.image_files import known_images, stored_digests
from mkpc_kaggle.engine.store.tables import Kind, Result, Store, from_bytes
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.planarity import MIN_PLANE_SHARE
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats, ModelKind
from mkpc_kaggle.pipeline.pair import Regions
from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.models import Reconstruction, SfmModel
from mkpc_kaggle.scene.sfm import models_of
from mkpc_kaggle.scene.view_graph import BatchImage

TABLE = "table of pairs"  # the key of the table; each publication replaces the former one
NOT_REACHED = "not reached in time"
NOT_RECONSTRUCTED = "not reconstructed yet"
NO_CAMERAS = "no matches connect its images"
MIN_PAIRS = 2  # of a batch that is reconstructed: the minimum to connect three images
MAX_DRAWN_POINTS = 5000  # of a model, which are 60 kB in the store and enough for a picture


# Stored about the results


@dataclass(frozen=True)
class UnitFacts:
    """The facts about a unit's points on a pair: counts, seconds, critical regions of stage 2."""

    unit: str
    matches: int
    keypoints: int
    decode_seconds: float
    cluster_seconds: float
    encode_seconds: float
    match_seconds: float
    note: str
    regions: tuple[CriticalRegion, ...]  # of both images, or none
    # Of a unit of stage 2: whether the pair needs it, and the ratios of its ``CropNeed``
    is_needed: bool
    scale: float | None
    detail: float | None


UNIT_FACTS = record(
    UnitFacts,
    unit=PLAIN,
    matches=PLAIN,
    keypoints=PLAIN,
    decode_seconds=PLAIN,
    cluster_seconds=PLAIN,
    encode_seconds=PLAIN,
    match_seconds=PLAIN,
    note=PLAIN,
    regions=several(codec.REGION),
    is_needed=PLAIN,
    scale=PLAIN,
    detail=PLAIN,
)
ESTIMATED = record(
    Estimated,
    points=several(PLAIN),
    inliers=several(PLAIN),
    F=codec.MATRIX,
    failure=PLAIN,
    magsac=optional(codec.MATRIX),
    stats=codec.STATS,
    seconds=PLAIN,
)
# Of a pair that the run has not reached
NO_ESTIMATE = Estimated((), (), FALLBACK_FUNDAMENTAL, NOT_REACHED)


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
    is_needed: bool = True  # False for a unit of stage 2 that the pair does not need
    scale: float | None = None  # of a unit of stage 2, as in ``CropNeed``
    detail: float | None = None

    @classmethod
    def of(cls, facts: UnitFacts, stage: int, inliers: int) -> "UnitRecord":
        return cls(
            facts.unit,
            stage,
            facts.matches,
            inliers,
            facts.encode_seconds,
            facts.match_seconds,
            failure="",
            note=facts.note,
            keypoints=facts.keypoints,
            is_needed=facts.is_needed,
            scale=facts.scale,
            detail=facts.detail,
        )


@dataclass(frozen=True, eq=False, slots=True)
class PairRecord:
    """The F of a pair (E if the pair has intrinsics), with its origin.

    ``pair_fundamental`` comes from the pair's own matches. If ``failure`` is not empty, it is the fallback.
    ``magsac_fundamental`` is MAGSAC's result before refinement, if any. ``scene`` is the choice by the batch's
    scene, ``None`` without a scene. ``source`` says where the written ``chosen_fundamental`` comes from: "scene",
    "pair" or "fallback". Seconds belong to the present points and estimate.
    """

    index: int
    pair: Pair  # with image names in place of paths
    pair_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    failure: str = NOT_REACHED
    unestimated: str = ""  # the failure, if no worker could estimate F
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
    source: str = "fallback"
    chosen_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    model: str = ModelKind.F  # of both matrices

    @property
    def inliers(self) -> int:
        return sum(unit.inliers for unit in self.units)

    @property
    def is_solved(self) -> bool:
        return self.source != "fallback"

    @property
    def overlaps(self) -> bool:
        """True if the two images probably overlap."""
        return self.stats.support >= MIN_SUPPORT

    @property
    def is_flat(self) -> bool:
        """True if one homography explains the inliers of the pair's own F, so it is uncertain."""
        return self.stats.plane >= MIN_PLANE_SHARE

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED


@dataclass(frozen=True)
class Rival:
    """A candidate of a scene that was not chosen: its disagreement and its number of registered images."""

    candidate: str
    disagreement: float
    registered: int


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images and points, and the
    models.

    The largest model comes first. Each model has up to ``MAX_DRAWN_POINTS`` of its points, of the
    longest tracks, rounded to float32. Without a model, ``failure`` is the reason. ``choices`` has
    the choice for each pair, by the contents of its images (:func:`contents_of`).

    ``candidate`` states whose tracks were used, with its ``disagreement`` in degrees; ``rivals`` are the other
    candidates, the best first. The store has them as scenes.
    """

    batch: str
    images: int = 0
    registered: int = 0
    points: int = 0
    seconds: float = 0.0
    failure: str = ""
    models: tuple[SfmModel, ...] = field(default=(), compare=False)
    choices: Mapping[str, Choice] = field(default_factory=dict, compare=False)
    candidate: str = ALL_UNITS
    disagreement: float = 0.0
    rivals: tuple[Rival, ...] = ()

    @classmethod
    def of(
        cls,
        batch: str,
        found: Sequence[Reconstruction],
        seconds: float = 0.0,
        choices: Mapping[str, Choice] | None = None,
        candidate: str = ALL_UNITS,
        disagreement: float = 0.0,
    ) -> "SceneRecord":
        models = models_of(found)
        reasons = dict.fromkeys(each.failure for each in found if each.failure)
        return cls(
            batch,
            images=sum(len(each.names) for each in found),
            registered=sum(each.registered for each in found),
            points=sum(len(model.points) for model in models),
            seconds=seconds,
            failure="" if models else "; ".join(reasons) or NO_CAMERAS,
            models=tuple(replace(model, points=_drawn(model.points)) for model in models),
            choices=choices or {},
            candidate=candidate,
            # Later digits vary between processors
            disagreement=float(f"{disagreement:.6g}"),
        )

    @property
    def loose(self) -> int:
        """Number of images whose only cameras are in loose models (:attr:`SfmModel.is_loose`)."""
        sure = {found.image.name for m in self.models if not m.is_loose for found in m.images}
        return len({found.image.name for m in self.models for found in m.images} - sure)

    def against(self, others: Iterable["SceneRecord"]) -> "SceneRecord":
        """Return the record of the chosen candidate, with the others as rivals."""
        rivals = [Rival(each.candidate, each.disagreement, each.registered) for each in others]
        # The sort is stable: of equals, the former candidate first.
        rivals.sort(key=lambda rival: rival.disagreement)
        return replace(self, rivals=tuple(rivals))


def unmatched_scene(batch: str, pairs: Iterable[Pair]) -> SceneRecord:
    """Return the record of a batch whose pairs have no matches. It is not stored, as no scene is
    computed.
    """
    images = {file for pair in pairs for file in (pair.file0, pair.file1)}
    return SceneRecord(batch, images=len(images), failure=NO_CAMERAS)


def unmatched_scenes(records: Iterable[PairRecord]) -> list[SceneRecord]:
    """Return the records of the batches whose pairs have all been reached, without a match."""
    batches: dict[str, list[PairRecord]] = {}
    for found in records:
        batches.setdefault(found.pair.group, []).append(found)
    return [
        unmatched_scene(batch, (found.pair for found in members))
        for batch, members in batches.items()
        if len(members) >= MIN_PAIRS and not any(_may_match(found) for found in members)
    ]


def _may_match(found: PairRecord) -> bool:
    return found.matches > 0 or not found.reached


def _drawn(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points to store, rounded, so that a record is the same after it is read."""
    return points[:MAX_DRAWN_POINTS].astype(np.float32).astype(np.float64)


SCENE = record(
    SceneRecord,
    batch=PLAIN,
    images=PLAIN,
    registered=PLAIN,
    points=PLAIN,
    seconds=PLAIN,
    failure=PLAIN,
    models=several(codec.MODEL),
    choices=by_name(codec.CHOICE),
    candidate=PLAIN,
    disagreement=PLAIN,
)


# The table of pairs


@dataclass(frozen=True)
class About:
    """Facts for reports about the last run that wrote the store."""

    # The table of a recipe's file, and the recipe's name
    recipe: Mapping[str, Any] = field(default_factory=dict)
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: Sequence[str] = ()  # matchers that did not run, by cause
    # Of the package and its main dependencies
    versions: Mapping[str, str] = field(default_factory=dict)


ABOUT = record(About, recipe=PLAIN, device=PLAIN, limit=PLAIN, left_out=PLAIN, versions=PLAIN)


class Row(NamedTuple):
    """A pair in the table. ``points`` are the keys of its units' points, empty for a unit without
    points.

    ``failures`` are the reasons why units were given up, by unit; ``failure`` is why the pair has no points, and
    ``unestimated`` why it has points but no estimate, if not for lack of time.
    """

    # A named tuple and not a dataclass: JSON has it as a short list, and a table has thousands.
    id: str
    batch: str
    image0: str
    image1: str
    turns0: int
    turns1: int
    contents: str  # of both images, as in image_files.contents_of
    points: list[str]
    estimate: str
    source: str  # of the written F: "scene", "pair" or "fallback"; empty for an extra pair
    failures: dict[str, str]
    failure: str
    model: str = ModelKind.F  # of the written matrix; E for a pair with intrinsics
    unestimated: str = ""

    @property
    def pair(self) -> Pair:
        turns = (self.turns0, self.turns1)
        return Pair(self.id, self.batch, self.image0, self.image1, turns=turns)


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of all pairs, the keys of the batches' scenes, and the F of each row.

    The first ``count`` rows belong to the test set, the others to pairs for scenes alone.
    ``scenes`` has keys by batch, and ``rivals`` those of the other candidates. ``written`` is
    (count, 3, 3).
    """

    about: About = field(default_factory=About)
    units: Sequence[tuple[str, int]] = ()  # name and stage
    count: int = 0
    rows: Sequence[Row] = ()
    scenes: Mapping[str, str] = field(default_factory=dict)
    written: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))
    rivals: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def to_result(self) -> Result:
        """Return the table as a row of the store."""
        about = {
            "about": ABOUT.to_json(self.about),
            "units": self.units,
            "count": self.count,
            "rows": self.rows,
            "scenes": dict(self.scenes),
            "rivals": dict(self.rivals),
        }
        return Result(TABLE, Kind.TABLE, about, self.written.tobytes())

    @classmethod
    def of(cls, store: Store) -> Self:
        """Return the store's table, or an empty table if the run has not published yet."""
        found = store.about([TABLE]).get(TABLE)
        if found is None:
            return cls()
        data = store.data([TABLE]).get(TABLE)
        if data is None:  # damaged
            return cls()
        return cls(
            about=ABOUT.of_json(found["about"]),
            units=[(name, stage) for name, stage in found["units"]],
            count=found["count"],
            rows=[Row(*row) for row in found["rows"]],
            scenes=found["scenes"],
            written=np.frombuffer(data).reshape(-1, 3, 3),
            rivals=found["rivals"],
        )

    @property
    def image_names(self) -> list[str]:
        """The distinct names of all images, in order."""
        return list(dict.fromkeys(name for row in self.rows for name in (row.image0, row.image1)))

    @property
    def keys(self) -> list[str]:
        """The keys of all results that the table names."""
        points = [key for row in self.rows for key in row.points]
        estimates = [row.estimate for row in self.rows]
        rivals = [key for keys in self.rivals.values() for key in keys]
        return [key for key in [*points, *estimates, *self.scenes.values(), *rivals] if key]


# Events


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


EVENT = record(Event, kind=PLAIN, seconds=FLOAT, text=PLAIN)


# Reading


def read_records(store: Store, table: Table | None = None) -> list[PairRecord]:
    """Return the records of all pairs that have a row, in order."""
    table = table or Table.of(store)
    rows = table.rows[: table.count]
    # All keys in one query, which is much faster than one for each pair.
    keys = [key for row in rows for key in [*row.points, row.estimate] if key]
    about = store.about(keys)
    scenes = read_scenes(store, table)
    return [
        _pair_record(index, row, table, about, scenes.get(row.batch))
        for index, row in enumerate(rows)
    ]


def read_points(store: Store, table: Table, index: int) -> dict[str, Matches]:
    """Return a pair's matches by unit, in the recipe's order."""
    keys = table.rows[index].points
    data = store.data(filter(None, keys))
    named = zip(table.units, keys, strict=True)
    return {name: from_bytes(data[key]) for (name, _), key in named if key in data}


def read_images(store: Store, row: Row) -> tuple[BatchImage, ...]:
    """Return both images of a pair as last read, or an empty tuple if one is unknown."""
    names = [row.image0, row.image1]
    images = known_images(store, stored_digests(store, names))
    return tuple(images[name] for name in names) if images.keys() >= set(names) else ()


def read_scenes(store: Store, table: Table | None = None) -> dict[str, SceneRecord]:
    """Return the present reconstruction of each batch that has one."""
    table = table or Table.of(store)
    rivals = [key for keys in table.rivals.values() for key in keys]
    about = store.about([*table.scenes.values(), *rivals])
    scenes = {}
    for batch, key in table.scenes.items():
        if key not in about:
            continue
        others = [about[rival]["scene"] for rival in table.rivals.get(batch, ()) if rival in about]
        scene = SCENE.of_json(about[key]["scene"]).against(map(SCENE.of_json, others))
        # A batch may have another name than when its scene was stored: the key has only its contents.
        scenes[batch] = replace(scene, batch=batch)
    return scenes


def read_events(store: Store) -> tuple[Event, ...]:
    """Return all events of all sessions, in order."""
    return tuple(EVENT.of_json(about) for about in store.of_kind(Kind.EVENT).values())


def _pair_record(
    index: int,
    row: Row,
    table: Table,
    about: Mapping[str, Any],
    scene: SceneRecord | None,
) -> PairRecord:
    # Without an estimate, the row's failure is the reason, or the time.
    own = NO_ESTIMATE
    if row.estimate in about:
        own = ESTIMATED.of_json(about[row.estimate])
    elif reason := row.failure or row.unestimated:
        own = replace(NO_ESTIMATE, failure=reason)
    # By the key of points: points that are newer than the estimate have no inliers yet.
    inliers = dict(zip(own.points, own.inliers, strict=True))
    facts_of = {key: UNIT_FACTS.of_json(about[key]) for key in row.points if key in about}
    units = _unit_records(row, table, facts_of, inliers)
    found = facts_of.values()
    # All units of stage 2 in one job have the same regions; later jobs may have others.
    regions = next((facts.regions for facts in found if facts.regions), None)
    return PairRecord(
        index,
        row.pair,
        pair_fundamental=own.F,
        failure=own.failure,
        unestimated=row.unestimated,
        units=tuple(units),
        regions=None if regions is None else (regions[0], regions[1]),
        matches=sum(facts.matches for facts in found),
        decode_seconds=sum(facts.decode_seconds for facts in found),
        encode_seconds=sum(facts.encode_seconds for facts in found),
        match_seconds=sum(facts.match_seconds for facts in found),
        cluster_seconds=sum(facts.cluster_seconds for facts in found),
        estimate_seconds=own.seconds,
        scene=None if scene is None else scene.choices.get(row.contents),
        magsac_fundamental=own.magsac,
        stats=own.stats,
        source=row.source,
        chosen_fundamental=table.written[index],
        model=row.model,
    )


def _unit_records(
    row: Row,
    table: Table,
    facts_of: Mapping[str, UnitFacts],
    inliers: Mapping[str, int],
) -> list[UnitRecord]:
    """Return the records of a pair's units; ``facts_of`` and ``inliers`` are by the key of points."""
    units = []
    for (name, stage), key in zip(table.units, row.points, strict=True):
        if key in facts_of:
            units.append(UnitRecord.of(facts_of[key], stage, inliers.get(key, 0)))
        # A unit without points either raised or was not reached. Only failures are shown: their
        # reason is in the row.
        elif name in row.failures:
            units.append(UnitRecord(name, stage, 0, 0, 0.0, 0.0, row.failures[name]))
    return units
