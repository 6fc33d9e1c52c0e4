"""Results of a run by pair and batch, as values for reports and scores."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage

NOT_REACHED = "not reached in time"
NO_CAMERAS = "no matches connect its images"
Point = tuple[float, float, float]
MAX_DRAWN_POINTS = 300  # of a model, evenly chosen


@dataclass(frozen=True)
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
    pair_fundamental: Matrix3 = field(default_factory=FALLBACK_FUNDAMENTAL.copy)
    failure: str = NOT_REACHED
    units: Sequence[UnitRecord] = ()
    regions: Regions | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    scene: Choice | None = None
    magsac_fundamental: Matrix3 | None = None
    stats: EstimateStats = NO_STATS

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
    def overlaps(self) -> bool:
        """Whether the two images probably overlap."""
        return self.stats.support >= MIN_SUPPORT

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED

    @property
    def inliers(self) -> int:
        return sum(unit.inliers for unit in self.units)

    @property
    def matches(self) -> int:
        return sum(unit.matches for unit in self.units)

    @property
    def encode_seconds(self) -> float:
        return sum(unit.encode_seconds for unit in self.units)

    @property
    def match_seconds(self) -> float:
        return sum(unit.match_seconds for unit in self.units)


@dataclass(frozen=True)
class CameraRecord:
    """A camera of a scene: centre and axes in its model's units, focal length and size in pixels.

    ``down`` points to the image's lower border. ``digest`` identifies the image's content. ``model`` is the index
    of its model in the batch; 0 is the largest. ``seen`` is the number of points that the image sees. ``sigmas``:
    see :class:`RegisteredImage`.
    """

    image: str
    digest: str
    model: int
    centre: Point
    forward: Point
    down: Point
    focal: float
    size: Size
    seen: int
    sigmas: tuple[float, ...] = ()

    @property
    def camera(self) -> Camera:
        """The camera with its principal point at the image's centre."""
        (width, height), down, forward = self.size, np.array(self.down), np.array(self.forward)
        K = np.array([[self.focal, 0, (width - 1) / 2], [0, self.focal, (height - 1) / 2], [0, 0, 1]])
        R = np.stack([np.cross(down, forward), down, forward])
        return Camera(K, R, -R @ np.array(self.centre))

    @classmethod
    def of(cls, found: RegisteredImage, model: int) -> "CameraRecord":
        R, t, image = found.camera.R, found.camera.t, found.image
        centre, forward, down = (tuple(vector.tolist()) for vector in (-R.T @ t, R[2], R[1]))
        size, points, sigmas = image.size, found.points, found.sigmas
        return cls(image.name, image.digest, model, centre, forward, down, found.focal, size, points, sigmas)


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images, models and points.

    ``clouds`` are some points of each model, evenly chosen, in its units. ``failure`` says why there is no model.
    """

    batch: str
    images: int = 0
    registered: int = 0
    models: int = 0
    points: int = 0
    seconds: float = 0.0
    failure: str = ""
    cameras: tuple[CameraRecord, ...] = ()
    clouds: tuple[tuple[Point, ...], ...] = ()

    @classmethod
    def of(cls, batch: str, found: Sequence[Reconstruction], seconds: float = 0.0) -> "SceneRecord":
        models = sorted((model for each in found for model in each.models), key=lambda model: -len(model.images))
        reasons = dict.fromkeys(each.failure for each in found if each.failure)
        return cls(
            batch,
            sum(len(each.names) for each in found),
            sum(each.registered for each in found),
            len(models),
            sum(len(model.points) for model in models),
            seconds,
            "" if models else "; ".join(reasons) or NO_CAMERAS,
            tuple(CameraRecord.of(image, n) for n, model in enumerate(models) for image in model.images),
            tuple(_evenly(model.points) for model in models),
        )


def _evenly(points: NDArray[np.float64]) -> tuple[Point, ...]:
    chosen = np.linspace(0, len(points) - 1, min(MAX_DRAWN_POINTS, len(points))).round().astype(int)
    return tuple((x, y, z) for x, y, z in points[chosen].round(4).tolist())
