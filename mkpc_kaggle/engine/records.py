"""What is durable of a pair: its F, how it came about, and what each unit found and cost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Matrix3
from mkpc_kaggle.pipeline.pair import PairMatch, Regions
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.reconstruction import Reconstruction

NOT_REACHED = "not reached in time"
MOST_POINTS = 300
"""Of a scene's points that are kept to be drawn."""


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

    ``failure`` is empty, or says why ``F`` is the fallback. The seconds are those of all jobs on the pair.
    ``before`` is the number of inliers that it had when it was first upgraded; ``None`` if it never was.
    ``scene`` is what its batch's reconstruction says of it, ``None`` if there was none. ``versions`` tell the
    contents of the two images that were matched, empty where no file tells them. ``magsac`` is MAGSAC's F alone,
    where ``F`` comes from more than that.
    """

    index: int
    F: Matrix3
    failure: str
    units: tuple[UnitRecord, ...] = ()
    regions: Regions | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    before: int | None = None
    scene: Choice | None = None
    versions: tuple[str, ...] = ()
    magsac: Matrix3 | None = None

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
        found, seconds = match.estimate, (match.decode_seconds, match.cluster_seconds, match.estimate_seconds)
        return cls(
            index,
            found.matrix,
            found.failure,
            units,
            match.regions,
            *seconds,
            versions=match.versions,
            magsac=found.magsac,
        )

    def after(self, former: "PairRecord", before: int | None) -> "PairRecord":
        """The record of a later job on a pair: with the seconds of the ``former`` ones, and their regions."""
        return replace(
            self,
            regions=self.regions or former.regions,
            decode_seconds=former.decode_seconds + self.decode_seconds,
            cluster_seconds=former.cluster_seconds + self.cluster_seconds,
            estimate_seconds=former.estimate_seconds + self.estimate_seconds,
            before=before,
            scene=former.scene,
        )

    @property
    def fundamental(self) -> Matrix3:
        """What its batch's reconstruction gives it, else its own."""
        return self.F if self.scene is None or self.scene.F is None else self.scene.F

    @property
    def source(self) -> str:
        """Where :attr:`fundamental` comes from: "scene", "pair" or "fallback"."""
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
    def inliers_before(self) -> int:
        """The inliers of a pair before it was upgraded."""
        return self.inliers if self.before is None else self.before

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
    centre: list[float]
    forward: list[float]
    down: list[float]
    focal: float
    size: list[int]
    seen: int


@dataclass(frozen=True)
class SceneRecord:
    """What came of a batch: how many of its images have a camera, in how many models, with how many points.

    ``cloud`` are some points of the largest model, evenly chosen, in its units.
    """

    batch: str
    images: int
    placed: int
    models: int
    points: int
    seconds: float
    failure: str
    cameras: tuple[CameraRecord, ...] = ()
    cloud: tuple[list[float], ...] = ()

    @classmethod
    def of(cls, batch: str, scenes: Sequence[Reconstruction], seconds: float, failure: str) -> "SceneRecord":
        models = sorted((model for scene in scenes for model in scene.models), key=lambda one: -len(one.images))
        cameras = tuple(
            CameraRecord(
                image.image.name,
                number,
                (-image.camera.R.T @ image.camera.t).tolist(),
                image.camera.R[2].tolist(),
                image.camera.R[1].tolist(),
                image.focal,
                list(image.image.size),
                image.points,
            )
            for number, model in enumerate(models)
            for image in model.images
        )
        reasons = [scene.failure for scene in scenes if scene.failure] if not models else []
        return cls(
            batch,
            sum(len(scene.names) for scene in scenes),
            sum(scene.registered for scene in scenes),
            len(models),
            sum(len(model.points) for model in models),
            seconds,
            failure or "; ".join(dict.fromkeys(reasons)) or ("" if models else "no matches connect its images"),
            cameras,
            tuple(evenly(models[0].points, MOST_POINTS).round(4).tolist()) if models else (),
        )


def evenly(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """At most that many of the rows, evenly chosen."""
    places = np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int)
    chosen: NDArray[np.float64] = points[places]
    return chosen
