"""What is durable of a pair: its F, how it came about, and what each unit found and cost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import PairMatch, Regions, UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage

NOT_REACHED = "not reached in time"
Point = tuple[float, float, float]
GIVEN_UP = "given up: "  # how the failure of a unit begins that workers were lost at
MAX_DRAWN_POINTS = 300  # of a scene, which are kept to be drawn


@dataclass(frozen=True)
class UnitRecord:
    """What a unit found on a pair: counts of matches and of inliers among them, and seconds."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str
    note: str = ""  # why the unit ran otherwise than it is written
    keypoints: int = 0  # detected in the first view; 0 for a matcher without a detector

    @classmethod
    def of(cls, found: UnitResult, inliers: int) -> "UnitRecord":
        unit, seconds = found.unit, (found.encode_seconds, found.match_seconds)
        counts = len(found.matches), inliers
        return cls(unit.name, unit.stage, *counts, *seconds, found.failure, found.note, found.keypoints)

    def result(self, unit: Unit, matches: Matches) -> UnitResult:
        """What the record was made of."""
        seconds = self.encode_seconds, self.match_seconds
        return UnitResult(unit, matches, *seconds, self.failure, note=self.note, keypoints=self.keypoints)


@dataclass(frozen=True, eq=False, slots=True)
class PairRecord:
    """What is known of a pair: its F (its E, where the pair has intrinsics) and how it came about.

    ``estimation`` is the digest of the settings that made its F of the units' points: :class:`Recipe` has it.

    ``pair_fundamental`` is from the pair's own matches, and the fallback where ``failure`` says why there is none;
    ``magsac_fundamental`` is MAGSAC's alone, where the former comes from more than that. The seconds are those of
    all jobs on the pair. ``scene`` is what its batch's reconstruction says of it, ``None`` if there was none.
    ``sizes``, ``versions`` and ``focals`` are of the two images that were matched: a version tells the content of
    a file, a focal length is in pixels by its EXIF, 0 if unknown.
    """

    index: int
    pair_fundamental: Matrix3
    failure: str
    units: tuple[UnitRecord, ...] = ()
    regions: Regions | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    scene: Choice | None = None
    sizes: tuple[Size, ...] = ()
    versions: tuple[str, ...] = ()
    magsac_fundamental: Matrix3 | None = None
    estimation: str = ""
    stats: EstimateStats = NO_STATS
    focals: tuple[float, ...] = ()

    @classmethod
    def untouched(cls, index: int, reason: str = NOT_REACHED) -> "PairRecord":
        return cls(index, FALLBACK_FUNDAMENTAL, reason)

    @classmethod
    def of(cls, index: int, match: PairMatch, estimation: str = "") -> "PairRecord":
        ends = np.cumsum([len(result.matches) for result in match.results])
        inliers = [int(mask.sum()) for mask in np.split(match.estimate.inliers, ends[:-1])]
        units = tuple(map(UnitRecord.of, match.results, inliers))
        return cls(
            index,
            match.estimate.matrix,
            match.estimate.failure,
            units,
            match.regions,
            match.decode_seconds,
            match.cluster_seconds,
            match.estimate_seconds,
            sizes=match.sizes,
            versions=match.versions,
            magsac_fundamental=match.estimate.magsac,
            estimation=estimation,
            stats=match.estimate.stats,
            focals=match.focals,
        )

    def after(self, former: "PairRecord") -> "PairRecord":
        """The record of a later job on a pair: with the seconds of the ``former`` jobs, and their regions."""
        parts = ("decode_seconds", "cluster_seconds", "estimate_seconds")
        seconds = {part: getattr(former, part) + getattr(self, part) for part in parts}
        return replace(self, regions=self.regions or former.regions, scene=former.scene, **seconds)

    def without_given_up(self) -> "PairRecord":
        units = tuple(unit for unit in self.units if not unit.failure.startswith(GIVEN_UP))
        if len(units) == len(self.units):
            return self
        return replace(self, units=units) if units else PairRecord.untouched(self.index)

    @property
    def chosen_fundamental(self) -> Matrix3:
        """The F that is written: what its batch's reconstruction gives the pair, else its own."""
        return self.pair_fundamental if self.scene is None or self.scene.F is None else self.scene.F

    @property
    def source(self) -> str:
        """Where :attr:`chosen_fundamental` comes from: "scene", "pair" or "fallback"."""
        if self.scene is None or self.scene.F is None:
            return "fallback" if self.failure else "pair"
        return "scene" if self.scene.from_scene else "pair"

    @property
    def overlaps(self) -> bool:
        """Whether the two images most likely show the same thing."""
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

    def lacking(self, units: Iterable[Unit]) -> list[Unit]:
        """Those of ``units`` that the pair has not had."""
        had = {record.unit for record in self.units}
        return [unit for unit in units if unit.name not in had]


@dataclass(frozen=True)
class CameraRecord:
    """A camera of a scene: where it is and looks, in its model's units, and its focal length in pixels.

    ``down`` is where the image's lower border is; ``size`` are its width and height in pixels. ``model`` numbers
    the models of the batch, the largest is 0; ``seen`` are the points that the image sees.
    """

    image: str
    model: int
    centre: Point
    forward: Point
    down: Point
    focal: float
    size: Size
    seen: int

    @property
    def camera(self) -> Camera:
        """The principal point is the image's centre."""
        (width, height), down, forward = self.size, np.array(self.down), np.array(self.forward)
        K = np.array([[self.focal, 0, (width - 1) / 2], [0, self.focal, (height - 1) / 2], [0, 0, 1]])
        R = np.stack([np.cross(down, forward), down, forward])
        return Camera(K, R, -R @ np.array(self.centre))

    @classmethod
    def of(cls, found: RegisteredImage, model: int) -> "CameraRecord":
        R, t = found.camera.R, found.camera.t
        centre, forward, down = (tuple(vector.tolist()) for vector in (-R.T @ t, R[2], R[1]))
        return cls(found.image.name, model, centre, forward, down, found.focal, found.image.size, found.points)


@dataclass(frozen=True)
class SceneRecord:
    """What came of a batch: how many of its images have a camera, in how many models, with how many points.

    ``unit_results``: how many unit results the scene is made of; if its pairs have more, it is out of date.
    ``estimation`` is the digest of the settings that made it. ``clouds`` are some points of each model, evenly
    chosen, in its units.
    """

    batch: str
    images: int
    registered: int
    models: int
    points: int
    unit_results: int
    seconds: float
    failure: str
    cameras: tuple[CameraRecord, ...] = ()
    clouds: tuple[tuple[Point, ...], ...] = ()
    estimation: str = ""

    @classmethod
    def of(
        cls,
        batch: str,
        found: Sequence[Reconstruction],
        unit_results: int = 0,
        seconds: float = 0.0,
        estimation: str = "",
        failure: str = "",
    ) -> "SceneRecord":
        models = sorted((model for each in found for model in each.models), key=lambda model: -len(model.images))
        cameras = tuple(CameraRecord.of(image, n) for n, model in enumerate(models) for image in model.images)
        reasons = dict.fromkeys(each.failure for each in found if each.failure and not models)
        return cls(
            batch,
            sum(len(each.names) for each in found),
            sum(each.registered for each in found),
            len(models),
            sum(len(model.points) for model in models),
            unit_results,
            seconds,
            failure or "; ".join(reasons) or ("" if models else "no matches connect its images"),
            cameras,
            tuple(_evenly(model.points) for model in models),
            estimation,
        )


def _evenly(points: NDArray[np.float64]) -> tuple[Point, ...]:
    chosen = np.linspace(0, len(points) - 1, min(MAX_DRAWN_POINTS, len(points))).round().astype(int)
    return tuple((x, y, z) for x, y, z in points[chosen].round(4).tolist())
