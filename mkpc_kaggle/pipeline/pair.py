"""A pair on its way through the stages: results of units, critical regions, the two-view model."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, regions_of
from mkpc_kaggle.geometry.crop_need import CropNeed
from mkpc_kaggle.geometry.focal_prior import FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, estimate
from mkpc_kaggle.pipeline.arguments import ImageSource, as_image
from mkpc_kaggle.recipe import Recipe, Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Regions = tuple[CriticalRegion, CriticalRegion]
# A complete value, so that an interrupted pair has a row like any other.
NOT_ESTIMATED = Estimate.failed(ModelKind.F, 0, "not estimated yet")


@dataclass(frozen=True, eq=False)
class UnitResult:
    """Result of a unit on a pair: matches in image pixels, times in seconds."""

    unit: Unit
    matches: Matches
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    failure: str = ""  # the reason for a result without matches
    # The first run of the unit in this process, which may take much longer
    warm_up: bool = False
    note: str = ""  # why the unit did not run as written
    keypoints: int = 0  # detected in the first view; 0 for a matcher without a detector
    need: CropNeed | None = None  # of stage 2; one that is not needed has no matches
    regions: Regions | None = None  # of stage 2: its crops

    @property
    def is_needed(self) -> bool:
        """False for a unit of stage 2 that the pair does not need."""
        return self.need is None or self.need.is_needed

    @property
    def seconds(self) -> float:
        """The time of both steps."""
        return self.encode_seconds + self.match_seconds


@dataclass(frozen=True, eq=False)
class PairMatch:
    """A pair with its results so far; each step returns a new one.

    Parameters
    ----------
    results : tuple of UnitResult
        In the order of execution; once estimated, in the recipe's order.
    regions : pair of CriticalRegion, optional
        ``None`` until a unit of stage 2 needs them.
    estimate : Estimate
        The two-view model of all matches.
    images : tuple of Image
        Both, while units run; afterwards only ``sizes`` and ``focals`` remain.
    sizes, focals
        Width and height, and the focal length by EXIF, of each image, in pixels.
    failure : str
        The image that cannot be read.
    scale : float
        The ratio of the scales of both images, known with the regions.

    Examples
    --------
    >>> from mkpc_kaggle import TwoStageMatcher
    >>> match = TwoStageMatcher("sift")("a.jpg", "b.jpg")
    >>> len(match.inliers) == match.estimate.inlier_count
    True
    """

    results: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    estimate: Estimate = NOT_ESTIMATED
    images: tuple[Image, ...] = ()
    sizes: tuple[Size, ...] = ()
    focals: tuple[float, ...] = ()
    failure: str = ""
    scale: float = 1.0

    @property
    def matches(self) -> Matches:
        """The matches of all units; ``estimate.inliers`` is a mask over them."""
        return Matches.concatenate(result.matches for result in self.results)

    @property
    def failures(self) -> dict[str, str]:
        """The reason of each unit that failed, by the unit's name."""
        return {result.unit.name: result.failure for result in self.results if result.failure}

    @property
    def inliers(self) -> Matches:
        """The matches within MAGSAC's threshold of the model."""
        return self.matches[self.estimate.inliers]

    def plot(self, image0: ImageSource, image1: ImageSource) -> "Figure":
        """Draw the matches and the critical regions on the two images.

        Raises :class:`mkpc_kaggle.errors.UserError` without matplotlib.
        """
        from mkpc_kaggle.pipeline.drawing import draw_pair  # it draws this class

        return draw_pair((as_image(image0), as_image(image1)), self)

    @classmethod
    def of_stored(
        cls,
        stored: Iterable[tuple[Unit, bytes | None, str]],
        F: Matrix3,
        count: int,
        failure: str,
    ) -> "PairMatch":
        """Return a pair from the matches of its units, as bytes, if any, and its regions, as text. The inliers
        of F are the ``count`` matches that are nearest to it.
        """
        results = []
        regions = None
        for unit, data, text in stored:
            if data is not None:
                results.append(UnitResult(unit, Matches.from_bytes(data)))
            regions = regions_of(text) or regions
        match = cls(tuple(results), regions)
        return replace(match, estimate=Estimate.of_nearest(F, match.matches, count, failure))

    def facts(self, keys: Iterable[str]) -> dict[str, object]:
        """Return the estimate as JSON values, under the names that they have in a store.

        ``F`` and ``magsac``, that before the prior, are nine numbers, row by row. ``inliers`` has a count for each
        result, by its key.
        """
        found = self.estimate
        # The inliers of each unit, by the bounds of its matches among all
        bounds = np.cumsum([len(result.matches) for result in self.results])
        masks = np.split(found.inliers, bounds[:-1])
        return {
            "F": found.matrix.ravel().tolist(),
            "failure": found.failure,
            "magsac": None if found.magsac is None else found.magsac.ravel().tolist(),
            "inliers": {key: int(mask.sum()) for key, mask in zip(keys, masks, strict=True)},
        }

    def in_stage(self, stage: int) -> NDArray[np.bool_]:
        """Return the (N,) mask of the ``matches`` that units of this stage found."""
        chosen = [result.unit.stage == stage for result in self.results]
        counts = [len(result.matches) for result in self.results]
        return np.repeat(np.array(chosen, bool), counts)


def with_estimate(
    pair: PairMatch,
    recipe: Recipe,
    model: ModelKind = ModelKind.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> PairMatch:
    """Return the pair with a two-view model estimated from all matches.

    The matches are sorted in the recipe's order, because MAGSAC's result depends on it. The
    recipe's focal prior, if any, uses the images' sizes and EXIF, or ``intrinsics`` if given.
    """
    ordered = sorted(pair.results, key=lambda result: recipe.units.index(result.unit))
    results = tuple(ordered)
    matches = Matches.concatenate(result.matches for result in results)
    sizes = pair.sizes or tuple(image.size for image in pair.images)
    # The prior is on the focal lengths of F and E.
    if recipe.focal is None or model is ModelKind.H:
        found = estimate(matches, recipe.magsac, model, intrinsics)
    else:
        if intrinsics is not None:
            priors = [FocalPrior(K, 0.0) for K in intrinsics]  # known: no deviation
        else:
            focals = pair.focals or tuple(image.focal for image in pair.images)
            both = zip(sizes, focals, strict=True)
            priors = [FocalPrior.of_image(size, focal) for size, focal in both]
        first, second = priors
        found = estimate_with_prior(
            matches, (first, second), recipe.magsac, recipe.focal, model
        )
    return replace(pair, results=results, estimate=found)
