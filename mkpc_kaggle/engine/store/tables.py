"""The tables of the store. Each is a dataclass, whose fields are the columns.

A fact of a result is described here and nowhere else: the engine has the dataclass, and reports
read the columns by SQL (:mod:`dataframes`). A change of a field changes ``STORE_FORMAT``, and stores of
another format are refused.
"""

import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.store.layout import Layout, layout_of
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.models import Reconstruction, SfmModel, models_of

NOT_RECONSTRUCTED = "not reconstructed yet"
NO_CAMERAS = "no matches connect its images"
MIN_PAIRS = 2  # of a batch that is reconstructed: the minimum to connect three images
MAX_DRAWN_POINTS = 5000  # of a model, which are 60 kB in the store and enough for a picture

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
    ``magsac`` is MAGSAC's result before refinement, if any. The statistics are described at
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

    ``key`` is that of the stored scene.
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
    key: str = field(default="", compare=False)
    rivals: tuple[Rival, ...] = field(default=(), metadata={"is_stored": False})

    @classmethod
    def of(
        cls,
        batch: str,
        reconstructions: Sequence[Reconstruction],
        seconds: float = 0.0,
        choices: Mapping[str, Choice] | None = None,
        candidate: str = ALL_UNITS,
        disagreement: float = 0.0,
        key: str = "",
    ) -> "SceneRecord":
        models = models_of(reconstructions)
        reasons = dict.fromkeys(
            reconstruction.failure for reconstruction in reconstructions if reconstruction.failure
        )
        return cls(
            batch,
            images=sum(len(reconstruction.names) for reconstruction in reconstructions),
            registered=sum(reconstruction.registered for reconstruction in reconstructions),
            points=sum(len(model.points) for model in models),
            seconds=seconds,
            failure="" if models else "; ".join(reasons) or NO_CAMERAS,
            models=tuple(replace(model, points=_drawn(model.points)) for model in models),
            choices=choices or {},
            candidate=candidate,
            # Later digits vary between processors
            disagreement=float(f"{disagreement:.6g}"),
            key=key,
        )

    def against(self, others: Iterable["SceneRecord"]) -> "SceneRecord":
        """Return the record of the chosen candidate, with the others as rivals."""
        rivals = [Rival(each.candidate, each.disagreement, each.registered) for each in others]
        # The sort is stable: of equals, the former candidate first.
        rivals.sort(key=lambda rival: rival.disagreement)
        return replace(self, rivals=tuple(rivals))


def unmatched_scene(batch: str, images: Collection[str]) -> SceneRecord:
    """Return the record of a batch whose images have no matches. It is not stored, as no scene is
    computed.
    """
    return SceneRecord(batch, images=len(images), failure=NO_CAMERAS)


def _drawn(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points to store, rounded, so that a record is the same after it is read."""
    return points[:MAX_DRAWN_POINTS].astype(np.float32).astype(np.float64)


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
    left_out: Sequence[str] = ()  # matchers without weights
    # Of the package and its main dependencies
    versions: dict[str, str] = field(default_factory=dict)
    # The images of each dataset of a folder, by batch, also those in no pair
    files: dict[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PublishedRun:
    """The latest version of a run's results: one row, next to the rows of the pairs.

    The first ``rows`` of the ``pairs`` belong to the test set, the others are for scenes alone. Rows of
    the table of pairs after them are of an earlier run. ``units`` has names and stages, ``scenes`` the keys of
    the scenes in use by batch, and ``rivals`` the keys of the other candidates. ``trials`` are keys of points and
    estimates of pairs that the run has tried, and does not have.
    """

    name: str = "run"
    about: About = field(default_factory=About)
    units: Sequence[Sequence[Any]] = ()
    rows: int = 0
    pairs: int = 0
    scenes: dict[str, str] = field(default_factory=dict)
    rivals: dict[str, list[str]] = field(default_factory=dict)
    trials: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class PublishedPair:
    """A pair as it was published last.

    ``points`` are the keys of its units' points, empty for a unit without points. ``F`` is the matrix
    that was written, F or E as ``model`` says, and ``source`` where it comes from: "scene", "pair",
    "earlier" (an earlier run) or "fallback"; empty for an extra pair. ``choice`` is the
    reason of the scene's choice, if there is a scene.

    ``failures`` are the reasons why units were given up, by unit; ``failure`` is why the pair has no points, and
    ``unestimated`` why it has points but no estimate, unless the time was too short.
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


LAYOUTS: dict[Any, Layout[Any]] = {
    kind: layout_of(kind, table, key)
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
    )
}
SCHEMA = ";\n".join(layout.sql for layout in LAYOUTS.values()) + ";"
# Increase it when the JSON or the bytes of a column change their meaning: nothing is converted.
REVISION = 1
STORE_FORMAT = zlib.crc32(f"{REVISION} {SCHEMA}".encode()) >> 1  # SQLite has 31 bits for it
# The results that a prune may remove. The other tables are small, or no pair names their rows.
PRUNED = (UnitPoints, PairEstimate, SceneRecord)
