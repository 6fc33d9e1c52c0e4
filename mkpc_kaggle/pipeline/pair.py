"""What is known of one pair on its way through the stages."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.focal_prior import FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, Matrix3, ModelKind, estimate
from mkpc_kaggle.recipe import Recipe, Unit

Regions = tuple[CriticalRegion, CriticalRegion]

NOT_ESTIMATED = Estimate.failed(ModelKind.F, 0, "not estimated yet")


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What one unit found on one pair, in image pixels, and what it cost in seconds.

    ``failure`` is empty, or says why there are no matches, or why the unit ran smaller than it is written.
    ``warm_up`` says that this process ran the unit for the first time, which may take much longer than later runs.
    """

    unit: Unit
    matches: Matches
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    failure: str = ""
    warm_up: bool = False

    @property
    def seconds(self) -> float:
        return self.encode_seconds + self.match_seconds


@dataclass(frozen=True, eq=False)
class PairMatch:
    """All that is known of one pair: each unit's matches, the critical regions, the two-view model.

    ``regions`` is ``None`` until a unit of stage 2 wanted them. ``matches`` are those of all units, and
    ``estimate.inliers`` is a mask over them; with the estimate they come into the recipe's order. ``images`` are
    the two images, there while units run; their ``sizes`` and ``versions`` stay. ``failure`` is empty, or says
    which image cannot be read.
    """

    results: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    estimate: Estimate = NOT_ESTIMATED
    images: tuple[Image, ...] = ()
    sizes: tuple[Size, ...] = ()
    versions: tuple[str, ...] = ()
    failure: str = ""
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0

    @property
    def matches(self) -> Matches:
        return Matches.concatenate(result.matches for result in self.results)

    @property
    def inliers(self) -> Matches:
        return self.matches[self.estimate.inliers]

    @property
    def stage1_matches(self) -> Matches:
        return Matches.concatenate(result.matches for result in self.results if result.unit.stage == 1)

    def has(self, unit: Unit) -> bool:
        return any(result.unit == unit for result in self.results)

    def in_stage(self, stage: int) -> NDArray[np.bool_]:
        """(N,) mask: which of ``matches`` the units of that stage found."""
        chosen = [result.unit.stage == stage for result in self.results]
        return np.repeat(np.array(chosen, bool), [len(result.matches) for result in self.results])


def with_estimate(
    pair: PairMatch,
    recipe: Recipe,
    model: ModelKind = ModelKind.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> PairMatch:
    """The pair with its two-view model from all matches, in the recipe's order: MAGSAC's result depends on it.

    Where the recipe has a prior on focal lengths, it goes by the images' sizes, unless ``intrinsics`` are given.
    """
    order = {unit: number for number, unit in enumerate(recipe.units)}
    results = tuple(sorted(pair.results, key=lambda result: order[result.unit]))
    matches = Matches.concatenate(result.matches for result in results)
    if recipe.focal is None or model is ModelKind.H:
        found = estimate(matches, recipe.magsac, model, intrinsics)
    else:
        sizes = pair.sizes or tuple(image.size for image in pair.images)
        known = [FocalPrior(K, 0.0) for K in intrinsics or ()]
        first, second = known or [FocalPrior.of_image(size, recipe.focal) for size in sizes]
        found = estimate_with_prior(matches, (first, second), recipe.magsac, recipe.focal, model)
    return replace(pair, results=results, estimate=found)
