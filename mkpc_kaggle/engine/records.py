"""What is durable of a pair: its F, how it came about, and what each unit found and cost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Matrix3
from mkpc_kaggle.pipeline.pair import PairMatch, Regions
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.reconstruction import Reconstruction

NOT_REACHED = "not reached in time"
Point = tuple[float, float, float]
GIVEN_UP = "given up: "  # how the failure of a unit begins that workers were lost at
MAX_DRAWN_POINTS = 300  # of a scene, which are kept to be drawn


@dataclass(frozen=True)
class UnitRecord:
    """What one unit found on one pair: counts of matches and of inliers among them, and seconds."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str


@dataclass(frozen=True, eq=False, slots=True)
class PairRecord:
    """What is known of one pair: its F (its E, where the pair has intrinsics) and how it came about.

    ``pair_fundamental`` is from the pair's own matches, and the fallback where ``failure`` says why there is none;
    ``magsac_fundamental`` is MAGSAC's alone, where the former comes from more than that. The seconds are those of
    all jobs on the pair. ``scene`` is what its batch's reconstruction says of it, ``None`` if there was none.
    ``sizes`` and ``versions`` are of
    the two images that were matched; a version tells the content of a file.
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

    @classmethod
    def untouched(cls, index: int, reason: str = NOT_REACHED) -> "PairRecord":
        return cls(index, FALLBACK_FUNDAMENTAL, reason)

    @classmethod
    def of(cls, index: int, match: PairMatch) -> "PairRecord":
        """The record of an estimated pair."""
        ends = np.cumsum([len(result.matches) for result in match.results])
        inliers = np.split(match.estimate.inliers, ends[:-1])
        units = tuple(
            UnitRecord(
                result.unit.name,
                result.unit.stage,
                len(result.matches),
                int(mask.sum()),
                result.encode_seconds,
                result.match_seconds,
                result.failure,
            )
            for result, mask in zip(match.results, inliers, strict=True)
        )
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
        )

    def after(self, former: "PairRecord") -> "PairRecord":
        """The record of a later job on a pair: with the seconds of the ``former`` ones, and their regions."""
        return replace(
            self,
            regions=self.regions or former.regions,
            decode_seconds=former.decode_seconds + self.decode_seconds,
            cluster_seconds=former.cluster_seconds + self.cluster_seconds,
            estimate_seconds=former.estimate_seconds + self.estimate_seconds,
            scene=former.scene,
        )

    def without_given_up(self) -> "PairRecord":
        """The record without the units that were given up: they may be tried again."""
        units = tuple(unit for unit in self.units if not unit.failure.startswith(GIVEN_UP))
        if len(units) == len(self.units):
            return self
        return replace(self, units=units) if units else PairRecord.untouched(self.index)

    @property
    def scene_fundamental(self) -> Matrix3 | None:
        return None if self.scene is None else self.scene.F

    @property
    def chosen_fundamental(self) -> Matrix3:
        """The F that is written: what its batch's reconstruction gives the pair, else its own."""
        return self.pair_fundamental if self.scene_fundamental is None else self.scene_fundamental

    @property
    def source(self) -> str:
        """Where :attr:`chosen_fundamental` comes from: "scene", "pair" or "fallback"."""
        if self.scene is not None and self.scene.F is not None:
            return "scene" if self.scene.from_scene else "pair"
        return "fallback" if self.failure else "pair"

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

    def has(self, unit: Unit) -> bool:
        return any(record.unit == unit.name for record in self.units)

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


@dataclass(frozen=True)
class SceneRecord:
    """What came of a batch: how many of its images have a camera, in how many models, with how many points.

    It was made from so many unit results on its pairs: if these have more now, the scene is out of date. ``cloud``
    are some points of the largest model, evenly chosen, in its units.
    """

    batch: str
    images: int
    placed: int
    models: int
    points: int
    made_from: int
    seconds: float
    failure: str
    cameras: tuple[CameraRecord, ...] = ()
    cloud: tuple[Point, ...] = ()

    @classmethod
    def of(
        cls,
        batch: str,
        reconstructions: Sequence[Reconstruction],
        made_from: int,
        seconds: float,
        failure: str = "",
    ) -> "SceneRecord":
        found = (model for reconstruction in reconstructions for model in reconstruction.models)
        models = sorted(found, key=lambda model: -len(model.images))
        cameras = tuple(
            CameraRecord(
                found.image.name,
                number,
                tuple((-found.camera.R.T @ found.camera.t).tolist()),
                tuple(found.camera.R[2].tolist()),
                tuple(found.camera.R[1].tolist()),
                found.focal,
                found.image.size,
                found.points,
            )
            for number, model in enumerate(models)
            for found in model.images
        )
        reasons = [each.failure for each in reconstructions if each.failure and not models]
        return cls(
            batch,
            sum(len(each.names) for each in reconstructions),
            sum(each.registered for each in reconstructions),
            len(models),
            sum(len(model.points) for model in models),
            made_from,
            seconds,
            failure or "; ".join(dict.fromkeys(reasons)) or ("" if models else "no matches connect its images"),
            cameras,
            tuple(map(tuple, evenly(models[0].points, MAX_DRAWN_POINTS).round(4).tolist())) if models else (),
        )


def evenly(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """At most that many of the rows, evenly chosen."""
    places = np.linspace(0, len(points) - 1, min(count, len(points))).round().astype(int)
    chosen: NDArray[np.float64] = points[places]
    return chosen
