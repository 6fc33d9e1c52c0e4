"""The two-stage pipeline on a chunk of pairs.

Stage 1 matches whole images, MKPC finds the critical region of each, stage 2 matches the crops; the points of
both stages, in image pixels, are concatenated in the recipe's order, and MAGSAC does the rest, alone or under the
recipe's prior on focal lengths.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.cache import ByteCache
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import CriticalRegion, critical_region
from mkpc_kaggle.geometry.focal_prior import FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, Matrix3, Model, estimate
from mkpc_kaggle.matchers.contract import Colour, Matcher, MatcherSpec, Picture, encoding_bytes
from mkpc_kaggle.recipe import Recipe, Unit

ENCODING_CACHE_BYTES = 2 << 30

Regions = tuple[CriticalRegion, CriticalRegion]


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What one unit found on one pair, in image pixels, and what it cost in seconds.

    ``failure`` is empty, or says why there are no matches, or why the unit ran smaller than it is written;
    ``exhausted`` that memory was short, so that the unit may do well on fewer pairs or smaller views.
    """

    unit: Unit
    matches: Matches
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    failure: str = ""
    exhausted: bool = False

    @property
    def seconds(self) -> float:
        return self.encode_seconds + self.match_seconds


@dataclass(frozen=True, eq=False)
class PairMatch:
    """All that is known of one pair: each unit's matches, the critical regions, the two-view model.

    ``regions`` is ``None`` until a unit of stage 2 wanted them. ``matches`` are those of all units, in the
    recipe's order, and ``estimate.inliers`` is a mask over them.
    """

    results: tuple[UnitResult, ...]
    regions: Regions | None
    estimate: Estimate

    @property
    def matches(self) -> Matches:
        return Matches.concatenate(result.matches for result in self.results)

    @property
    def inliers(self) -> Matches:
        return self.matches[self.estimate.inliers]

    def in_stage(self, stage: int) -> NDArray[np.bool_]:
        """(N,) mask: which of ``matches`` the units of that stage found."""
        chosen = [result.unit.stage == stage for result in self.results]
        return np.repeat(np.array(chosen, bool), [len(result.matches) for result in self.results])


@dataclass(frozen=True, eq=False)
class PairWork:
    """A pair on its way through the stages: its images, what was found so far, and the regions if known."""

    images: tuple[Image, Image]
    results: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    cluster_seconds: float = 0.0

    @property
    def sizes(self) -> tuple[Size, Size]:
        return self.images[0].size, self.images[1].size

    def has(self, unit: Unit) -> bool:
        return any(result.unit == unit for result in self.results)

    def stage1_matches(self) -> Matches:
        return Matches.concatenate(result.matches for result in self.results if result.unit.stage == 1)


class Pipeline:
    """A recipe's units, run on chunks of pairs with matchers that are loaded when first needed.

    ``load(name)`` gives the matcher of that name. Views of one shape are encoded ``batch`` at a time; encodings of
    whole images are kept in ``cache_bytes``.
    """

    def __init__(
        self,
        recipe: Recipe,
        load: Callable[[str], Matcher[Any]],
        *,
        batch: int = 1,
        cache_bytes: int = ENCODING_CACHE_BYTES,
    ) -> None:
        self.recipe = recipe
        self.batch = batch
        self._load = load
        self._matchers: dict[str, Matcher[Any]] = {}
        self._encodings: ByteCache[tuple[str, str, View], Any] = ByteCache(cache_bytes)

    def load(self) -> None:
        """Load all matchers of the recipe now; raises :class:`UserError` where one cannot be."""
        for name in self.recipe.matcher_names:
            self._matcher(name)

    def match(
        self, works: Sequence[PairWork], units: Iterable[Unit], keep_on: Callable[[Unit], bool] = lambda _: True
    ) -> list[PairWork]:
        """Run ``units`` on every pair that has not had them: stage 1, the critical regions, stage 2.

        ``keep_on(unit)`` is asked before each unit on each batch of pairs; once it says no, what was found
        so far is returned. A unit that raises has failed on its batch, with the error as its reason.
        """
        works = list(works)
        units = list(units)
        for unit in (unit for unit in units if unit.stage == 1):
            works = self._run_unit(unit, works, keep_on)
        if any(unit.stage == 2 for unit in units):
            works = [self._with_regions(work) for work in works]
        for unit in (unit for unit in units if unit.stage == 2):
            works = self._run_unit(unit, works, keep_on)
        return works

    def _with_regions(self, work: PairWork) -> PairWork:
        start = time.perf_counter()
        regions = regions_of(work.stage1_matches(), work.images, self.recipe)
        return replace(work, regions=regions, cluster_seconds=time.perf_counter() - start)

    def _run_unit(self, unit: Unit, works: list[PairWork], keep_on: Callable[[Unit], bool]) -> list[PairWork]:
        works = list(works)
        waiting = [number for number, work in enumerate(works) if not work.has(unit)]
        for start in range(0, len(waiting), self.batch):
            if not keep_on(unit):
                break
            numbers = waiting[start : start + self.batch]
            for number, result in zip(numbers, self._run_batch(unit, [works[n] for n in numbers]), strict=True):
                works[number] = replace(works[number], results=(*works[number].results, result))
        return works

    def _run_batch(self, unit: Unit, works: list[PairWork]) -> list[UnitResult]:
        try:
            return self._match_batch(unit, works)
        except Exception as error:  # whatever a matcher raises costs these pairs this unit, not the run
            lost = UnitResult(unit, Matches.empty(), failure=reason_of(error), exhausted=is_out_of_memory(error))
            return [lost for _ in works]

    def _match_batch(self, unit: Unit, works: list[PairWork]) -> list[UnitResult]:
        matcher = self._matcher(unit.matcher)
        views = [views_of(unit, matcher.spec, work) for work in works]
        start = time.perf_counter()
        wanted = [
            (image, view)
            for work, pair in zip(works, views, strict=True)
            for image, view in zip(work.images, pair, strict=True)
        ]
        encodings = self._encode(unit.matcher, wanted)
        encoded = time.perf_counter()
        found = matcher.match(encodings[::2], encodings[1::2])
        matched = time.perf_counter()
        return [
            UnitResult(
                unit,
                matches.to_image(*pair).best(unit.max_matches),
                (encoded - start) / len(works),
                (matched - encoded) / len(works),
            )
            for matches, pair in zip(found, views, strict=True)
        ]

    def _encode(self, name: str, wanted: Sequence[tuple[Image, View]]) -> list[Any]:
        """The encodings of views by the matcher of that name, from the cache or made now, one shape together."""
        matcher = self._matcher(name)
        keys = [(name, image.name, view) for image, view in wanted]
        known = {key: self._encodings.get(key) for key in keys}
        missing = {key: item for key, item in zip(keys, wanted, strict=True) if known[key] is None}
        by_shape: dict[Size, list[tuple[str, str, View]]] = {}
        for key in missing:
            by_shape.setdefault(key[2].padded, []).append(key)
        for alike in by_shape.values():
            for start in range(0, len(alike), self.batch):
                batch = alike[start : start + self.batch]
                pictures = [picture_of(*missing[key], matcher.spec.colour) for key in batch]
                for key, encoding in zip(batch, matcher.encode(pictures), strict=True):
                    known[key] = encoding
                    image, view = missing[key]
                    if view.crop == Box.whole(image.size):  # a crop is one pair's own: no other will ask for it
                        self._encodings.put(key, encoding, encoding_bytes(encoding))
        return [known[key] for key in keys]

    def _matcher(self, name: str) -> Matcher[Any]:
        if name not in self._matchers:
            self._matchers[name] = self._load(name)
        return self._matchers[name]


def reason_of(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, of OpenCV or of PyTorch, on a CPU or a GPU, says that memory is short."""
    # PyTorch has a type for GPUs alone; on a CPU it raises a RuntimeError, and OpenCV an error of its own.
    told = ("OutOfMemory", "can't allocate memory", "out of memory", "Insufficient memory", "Failed to allocate")
    return isinstance(error, MemoryError) or any(sign in reason_of(error) for sign in told)


def views_of(unit: Unit, spec: MatcherSpec, work: PairWork) -> tuple[View, View]:
    """What a unit looks at: whole images in stage 1, critical regions in stage 2."""
    if unit.stage == 1 or work.regions is None:
        boxes = [Box.whole(image.size) for image in work.images]
    else:
        boxes = [region.box for region in work.regions]
    view0, view1 = (unit.view(box, spec.multiple) for box in boxes)
    if spec.same_size:
        common = Size(*map(max, view0.padded, view1.padded))
        view0, view1 = replace(view0, padded=common), replace(view1, padded=common)
    return view0, view1


def picture_of(image: Image, view: View, colour: Colour) -> Picture:
    return Picture(view.render(image.gray if colour is Colour.GRAY else image.pixels), view)


def regions_of(matches: Matches, images: tuple[Image, Image], recipe: Recipe) -> Regions:
    """The critical region of each image, from the matched points of stage 1."""
    region0, region1 = (
        critical_region(points, image.size, recipe.mkpc)
        for points, image in zip((matches.points0, matches.points1), images, strict=True)
    )
    return region0, region1


def finish(
    work: PairWork,
    recipe: Recipe,
    model: Model = Model.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> PairMatch:
    """The pair's two-view model from all its matches, see :func:`conclude`."""
    return conclude(work.results, work.regions, work.sizes, recipe, model, intrinsics)


def conclude(
    results: Iterable[UnitResult],
    regions: Regions | None,
    sizes: tuple[Size, Size],
    recipe: Recipe,
    model: Model = Model.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> PairMatch:
    """The two-view model from all matches of a pair, in the recipe's order: MAGSAC's result depends on it.

    ``sizes`` are those of the images: where the recipe has a prior on focal lengths, it goes by them, unless the
    ``intrinsics`` are given.
    """
    order = {unit: number for number, unit in enumerate(recipe.units)}
    ordered = tuple(sorted(results, key=lambda result: order[result.unit]))
    matches = Matches.concatenate(result.matches for result in ordered)
    if recipe.focal is None or model is Model.H:
        return PairMatch(ordered, regions, estimate(matches, recipe.magsac, model, intrinsics))
    if intrinsics is not None:
        priors = FocalPrior(intrinsics[0], 0.0), FocalPrior(intrinsics[1], 0.0)
    else:
        priors = FocalPrior.of_image(sizes[0], recipe.focal), FocalPrior.of_image(sizes[1], recipe.focal)
    return PairMatch(ordered, regions, estimate_with_prior(matches, priors, recipe.magsac, recipe.focal, model))
