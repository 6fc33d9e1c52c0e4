"""Results of a run, for reports: records of pairs, units and scenes, and the same as DataFrames.

The latest version of the results is the table of pairs. It names the results that each pair has,
and the F that was written; nothing else decides what is written.
"""

from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.store import TABLE, Kind, Result, Store, from_bytes
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruct import Solution, models_of
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

if TYPE_CHECKING:
    from pandas import DataFrame

NOT_REACHED = "not reached in time"
NOT_RECONSTRUCTED = "not reconstructed in time"
NO_CAMERAS = "no matches connect its images"
# Prefixes of keys: of a file by its name, of the facts about an image by the digest of its content.
IMAGE = "image "
CONTENT = "content "
MAX_DRAWN_POINTS = 5000  # per model, of the longest tracks; 60 kB each


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
    """Facts for reports about the last run that wrote the store."""

    # The table of a recipe's file, and the recipe's name.
    recipe: Mapping[str, Any] = field(default_factory=dict)
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: Sequence[str] = ()  # matchers that did not run, by cause
    # Of the package and its main dependencies.
    versions: Mapping[str, str] = field(default_factory=dict)


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
    scene, ``None`` without a scene. ``source`` says where the written ``chosen_fundamental`` comes from: "scene",
    "pair" or "fallback". Seconds belong to the present points and estimate.
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
    source: str = "fallback"
    chosen_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)

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
    def reached(self) -> bool:
        return self.failure != NOT_REACHED


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images and points, and the
    models.

    The largest model comes first. Each model has up to ``MAX_DRAWN_POINTS`` of its points, of the
    longest tracks, rounded to float32. Without a model, ``failure`` is the reason. ``choices`` has
    the choice for each pair, by the contents of its images (:func:`contents_of`).
    """

    batch: str
    images: int = 0
    registered: int = 0
    points: int = 0
    seconds: float = 0.0
    failure: str = ""
    models: tuple[SfmModel, ...] = field(default=(), compare=False)
    choices: Mapping[str, Choice] = field(default_factory=dict, compare=False)

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
            tuple(replace(model, points=_drawn(model.points)) for model in models),
        )

    @classmethod
    def of_solution(
        cls, batch: str, answer: Solution, contents: Sequence[str], seconds: float
    ) -> "SceneRecord":
        """Return the record of an answer; ``contents`` are those of the pairs, in the answer's
        order.
        """
        record = cls.of(batch, answer.reconstructions, seconds)
        return replace(record, choices=dict(zip(contents, answer.choices, strict=True)))

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        choices = {
            contents: [str(choice.reason), _numbers(choice.F)]
            for contents, choice in self.choices.items()
        }
        return {
            "batch": self.batch,
            "images": self.images,
            "registered": self.registered,
            "points": self.points,
            "seconds": self.seconds,
            "failure": self.failure,
            "models": [_model_to_json(model) for model in self.models],
            "choices": choices,
        }

    @classmethod
    def of_json(cls, about: Mapping[str, Any]) -> "SceneRecord":
        """Invert :meth:`to_json`."""
        choices = {
            contents: Choice(_matrix(F), Reason(reason))
            for contents, (reason, F) in about["choices"].items()
        }
        models = tuple(_model_of_json(model) for model in about["models"])
        return cls(**{**about, "models": models, "choices": choices})


def contents_of(images: Sequence[BatchImage], turns: Sequence[int]) -> str:
    """Return a text that identifies the contents of a pair's images, and their quarter turns."""
    return " ".join([*(image.digest for image in images), *map(str, turns)])


# The table of pairs


class Row(NamedTuple):
    """A pair in the table. ``points`` are the keys of its units' points, empty for a unit without
    points.

    ``failures`` are the reasons why units raised, by unit; ``failure`` is why the pair has no points.
    """

    id: str
    batch: str
    image0: str
    image1: str
    turns0: int
    turns1: int
    contents: str
    points: list[str]
    estimate: str
    source: str
    failures: dict[str, str]
    failure: str

    @property
    def pair(self) -> Pair:
        turns = (self.turns0, self.turns1)
        return Pair(self.id, self.batch, self.image0, self.image1, turns=turns)


@dataclass(frozen=True, eq=False)
class Table:
    """The version of the results that was published last.

    The first ``count`` rows are those of the test set, the others pairs for scenes alone.
    ``scenes`` has the key of each batch's scene. ``written`` (count, 3, 3) is the F of each row.
    """

    about: About = field(default_factory=About)
    units: Sequence[tuple[str, int]] = ()  # name and stage
    count: int = 0
    rows: Sequence[Row] = ()
    scenes: Mapping[str, str] = field(default_factory=dict)
    written: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def to_result(self) -> Result:
        about = {
            "about": asdict(self.about),
            "units": self.units,
            "count": self.count,
            "rows": self.rows,
            "scenes": dict(self.scenes),
        }
        return Result(TABLE, Kind.TABLE, about, self.written.tobytes())

    @classmethod
    def of(cls, store: Store) -> Self:
        """Return the store's table; without one, an empty table."""
        found = store.about([TABLE]).get(TABLE)
        if found is None:  # the run has not published yet
            return cls()
        written = np.frombuffer(store.data([TABLE])[TABLE]).reshape(-1, 3, 3)
        units = [(name, stage) for name, stage in found["units"]]
        rows = [Row(*row) for row in found["rows"]]
        return cls(About(**found["about"]), units, found["count"], rows, found["scenes"], written)

    @property
    def keys(self) -> list[str]:
        """The keys of all results that the table names."""
        points = [key for row in self.rows for key in row.points]
        estimates = [row.estimate for row in self.rows]
        return [key for key in [*points, *estimates, *self.scenes.values()] if key]


def read_records(store: Store, table: Table | None = None) -> list[PairRecord]:
    """Return the records of all pairs that have a row, in order."""
    table = table or Table.of(store)
    rows = table.rows[: table.count]
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
    about = store.about(IMAGE + name for name in names)
    digests = {name: about[IMAGE + name]["digest"] for name in names if IMAGE + name in about}
    images = known_images(store, digests)
    return tuple(images[name] for name in names) if images.keys() >= set(names) else ()


def read_scenes(store: Store, table: Table | None = None) -> dict[str, SceneRecord]:
    """Return the present reconstruction of each batch that has one."""
    table = table or Table.of(store)
    about = store.about(table.scenes.values())
    return {
        batch: replace(SceneRecord.of_json(about[key]["scene"]), batch=batch)
        for batch, key in table.scenes.items()
        if key in about
    }


def read_events(store: Store) -> tuple[Event, ...]:
    """Return all events of all sessions, in order."""
    return tuple(Event(**about) for about in store.of_kind(Kind.EVENT).values())


def _pair_record(
    index: int, row: Row, table: Table, about: Mapping[str, Any], scene: SceneRecord | None
) -> PairRecord:
    estimate = about.get(row.estimate)
    inliers: dict[str, int] = {}  # by the key of points; newer points have none yet
    failure = row.failure or NOT_REACHED
    more: dict[str, Any] = {}
    if estimate is not None:
        inliers = dict(zip(estimate["points"], estimate["inliers"], strict=True))
        failure = estimate["failure"]
        stats = estimate["stats"]
        more["stats"] = EstimateStats(
            **{**stats, "focals": tuple(stats["focals"]), "rotation": tuple(stats["rotation"])}
        )
        more["pair_fundamental"] = _matrix(estimate["F"])
        more["magsac_fundamental"] = _matrix(estimate["magsac"])
        more["estimate_seconds"] = estimate["seconds"]
    units: list[UnitRecord] = []
    found = []
    for (name, stage), key in zip(table.units, row.points, strict=True):
        if key in about:
            points = about[key]
            found.append(points)
            units.append(
                UnitRecord(
                    name,
                    stage,
                    points["matches"],
                    inliers.get(key, 0),
                    points["encode_seconds"],
                    points["match_seconds"],
                    "",
                    points["note"],
                    points["keypoints"],
                )
            )
        elif name in row.failures:
            units.append(UnitRecord(name, stage, 0, 0, 0.0, 0.0, row.failures[name]))
    for name in ("matches", "decode_seconds", "cluster_seconds"):
        more[name] = sum(points[name] for points in found)
    for name in ("encode_seconds", "match_seconds"):
        more[name] = sum(points[name] for points in found)
    # The regions that the first unit of stage 2 looked at.
    boxes = next((points["regions"] for points in found if points["regions"]), None)
    if boxes is not None:
        more["regions"] = tuple(map(_region, boxes))
    if scene is not None:
        more["scene"] = scene.choices.get(row.contents)
    return PairRecord(
        index,
        row.pair,
        failure=failure,
        units=tuple(units),
        source=row.source,
        chosen_fundamental=table.written[index],
        **more,
    )


# DataFrames


class Results(NamedTuple):
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair.

    ``cameras`` has a row for each camera of each model. Columns that name a pair have its id.
    """

    pairs: "DataFrame"
    units: "DataFrame"
    cameras: "DataFrame"


def results(directory: Path | str) -> Results:
    """Return the results in a work directory (NAME.work), during a run or after it.

    Raises :class:`UserError` if the store is missing, damaged, or of another format.
    """
    with Store.read(Path(directory)) as store:
        table = Table.of(store)
        records = read_records(store, table)
        scenes = read_scenes(store, table)
    from pandas import DataFrame  # importing it takes half a second

    pairs = DataFrame([_pair_row(record) for record in records])
    units = [
        {"pair": record.pair.id, **asdict(unit)} for record in records for unit in record.units
    ]
    return Results(pairs, DataFrame(units), DataFrame(list(_camera_rows(scenes.values()))))


def _pair_row(record: PairRecord) -> dict[str, Any]:
    F = {
        f"f{n // 3 + 1}{n % 3 + 1}": value for n, value in enumerate(record.chosen_fundamental.flat)
    }
    return {
        "pair": record.pair.id,
        "group": record.pair.group,
        "image0": record.pair.names[0],
        "image1": record.pair.names[1],
        "failure": record.failure,
        "source": record.source,
        "matches": record.matches,
        "inliers": record.inliers,
        "overlaps": record.overlaps,
        "support": record.stats.support,
        "focal0": record.stats.focals[0],
        "focal1": record.stats.focals[1],
        **F,
    }


def _camera_rows(scenes: Iterable[SceneRecord]) -> Iterable[dict[str, Any]]:
    for scene in scenes:
        for number, model in enumerate(scene.models):
            for found in model.images:
                sigmas = found.sigmas or Sigmas(np.nan, np.nan, np.nan)
                yield {
                    "batch": scene.batch,
                    "model": number,
                    "image": found.image.name,
                    "width": found.image.size.width,
                    "height": found.image.size.height,
                    "focal": found.focal,
                    "points": found.points,
                    "rotation_sigma": sigmas.rotation,
                    "centre_sigma": sigmas.centre,
                    "focal_sigma": sigmas.focal,
                    "K": found.camera.K,
                    "R": found.camera.R,
                    "t": found.camera.t,
                }


# Values as JSON


def _numbers(matrix: NDArray[np.float64] | None) -> list[float] | None:
    return None if matrix is None else matrix.ravel().tolist()


def _matrix(numbers: Sequence[float] | None) -> Matrix3 | None:
    return None if numbers is None else np.array(numbers, float).reshape(3, 3)


def image_results(image: BatchImage, file: tuple[int, int]) -> list[Result]:
    """Return what is known of an image: the content of its file, and facts about this content."""
    facts = {"width": image.size.width, "height": image.size.height, "focal": image.focal}
    content = Result(CONTENT + image.digest, Kind.IMAGE, facts)
    return [file_result(image.name, image.digest, file), content]


def file_result(name: str, content: str, file: tuple[int, int]) -> Result:
    """Return the digest of a file's content, with the file's size and time of change."""
    return Result(IMAGE + name, Kind.IMAGE, {"digest": content, "file": list(file)})


def known_images(store: Store, digests: Mapping[str, str]) -> dict[str, BatchImage]:
    """Return the images whose contents are known, by name."""
    about = store.about(CONTENT + content for content in digests.values())
    images = {}
    for name, content in digests.items():
        if facts := about.get(CONTENT + content):
            size = Size(facts["width"], facts["height"])
            images[name] = BatchImage(name, content, size, facts["focal"])
    return images


def region_to_json(region: CriticalRegion) -> list[Any]:
    box = region.box
    sides = [box.left, box.top, box.right, box.bottom]
    return [*sides, str(region.reason), region.clusters, region.kept]


def _region(values: Sequence[Any]) -> CriticalRegion:
    left, top, right, bottom, reason, clusters, kept = values
    return CriticalRegion(Box(left, top, right, bottom), RegionReason(reason), clusters, kept)


def _model_to_json(model: SfmModel) -> dict[str, Any]:
    images = [
        {
            "name": found.image.name,
            "digest": found.image.digest,
            "size": list(found.image.size),
            "exif_focal": found.image.focal,
            "K": _numbers(found.camera.K),
            "R": _numbers(found.camera.R),
            "t": found.camera.t.tolist(),
            "points": found.points,
            "sigmas": list(found.sigmas),
        }
        for found in model.images
    ]
    return {
        "reprojection_error": float(model.reprojection_error),
        "points": _text_of_points(model.points),
        "images": images,
    }


def _model_of_json(about: Mapping[str, Any]) -> SfmModel:
    images = []
    for each in about["images"]:
        image = BatchImage(each["name"], each["digest"], Size(*each["size"]), each["exif_focal"])
        K = np.array(each["K"], float).reshape(3, 3)
        R = np.array(each["R"], float).reshape(3, 3)
        sigmas = Sigmas(*each["sigmas"]) if each["sigmas"] else ()
        camera = Camera(K, R, np.array(each["t"], float))
        images.append(RegisteredImage(image, camera, each["points"], sigmas))
    points = _points_of_text(about["points"])
    return SfmModel(tuple(images), points, about["reprojection_error"])


def _drawn(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points to store. A record is the same before it is stored and afterwards."""
    return _points_of_text(_text_of_points(points[:MAX_DRAWN_POINTS]))


def _text_of_points(points: NDArray[np.float64]) -> str:
    return b64encode(points.astype("<f4").tobytes()).decode("ascii")


def _points_of_text(text: str) -> NDArray[np.float64]:
    return np.frombuffer(b64decode(text), "<f4").reshape(-1, 3).astype(np.float64)
