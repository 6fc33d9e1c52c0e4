"""Results of a run by pair and batch, as values for reports and scores."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.reconstruct import models_of
from mkpc_kaggle.scene.reconstruction import Reconstruction, SfmModel

NOT_REACHED = "not reached in time"
NO_CAMERAS = "no matches connect its images"
MAX_DRAWN_POINTS = 300  # of a model, evenly chosen


@dataclass(frozen=True, slots=True)
class UnitRecord:
    """Result of a unit on a pair: numbers of matches and of inliers among them, and seconds."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str
    note: str = ""  # how the unit differed from its settings, such as the precision
    keypoints: int = 0  # detected in the first view; 0 for a matcher without a detector


@dataclass(frozen=True, eq=False, slots=True)
class PairRecord:
    """The F of a pair (E if the pair has intrinsics) and how it was found.

    ``pair_fundamental`` comes from the pair's own matches. It is the fallback if ``failure`` says why there is no
    F. ``magsac_fundamental`` is MAGSAC's alone if ``pair_fundamental`` was refined. ``scene`` is the choice by the
    scene of its batch, ``None`` without a scene. Seconds belong to the current points and estimate.
    """

    index: int
    pair: Pair  # with the names of its images for files
    pair_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    failure: str = NOT_REACHED
    units: Sequence[UnitRecord] = ()
    regions: Regions | None = None
    matches: int = 0  # this and the next four fields: of all units
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
        """The F to write: by the scene of its batch, else the pair's own."""
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
        """Whether the two images probably overlap."""
        return self.stats.support >= MIN_SUPPORT

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images and points, and its models.

    The largest model comes first. A model keeps some of its points, evenly chosen. Without a model, ``failure`` is
    the reason.
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


def _evenly(points: NDArray[np.float64]) -> NDArray[np.float64]:
    chosen = np.linspace(0, len(points) - 1, min(MAX_DRAWN_POINTS, len(points))).round().astype(int)
    return np.asarray(points[chosen])
