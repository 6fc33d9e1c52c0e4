"""The two-stage pipeline on a chunk of pairs.

Stage 1 matches whole images, MKPC finds the critical region of each, stage 2 matches the crops; the points of
both stages, in image pixels, are concatenated in the recipe's order, and MAGSAC does the rest.
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
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, Matrix3, Model, estimate
from mkpc_kaggle.matchers.contract import Colour, Matcher, MatcherSpec, Picture, encoding_bytes
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.recipe import Recipe, Unit

ENCODING_CACHE_BYTES = 2 << 30

Regions = tuple[CriticalRegion, CriticalRegion]


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What one unit found on one pair, in image pixels, and what it cost in seconds.

    ``failure`` is empty, or says why there are no matches, or why the unit ran smaller than it is written.
    """

    unit: Unit
    matches: Matches
    encode_seconds: float = 0.0
    match_seconds: float = 0.0
    failure: str = ""

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

    def has(self, unit: Unit) -> bool:
        return any(result.unit == unit for result in self.results)

    def stage1_matches(self) -> Matches:
        return Matches.concatenate(result.matches for result in self.results if result.unit.stage == 1)


class Pipeline:
    """A recipe's units, run on chunks of pairs with matchers that are loaded when first needed.

    ``load(name)`` gives the matcher of that name. Pairs are matched, and views of one shape encoded, ``batch`` at
    a time; fewer by a unit for which memory was short, from then on. Encodings of whole images are kept in
    ``cache_bytes``.
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
        self._batches: dict[Unit, int] = {}
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
        so far is returned. A unit that raises has failed on its batch, with the error as its reason; but errors of
        the device, and of memory that does not suffice for a single pair, are raised: see
        :mod:`mkpc_kaggle.pipeline.failures`.
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
        while waiting and keep_on(unit):
            numbers = waiting[: self._batches.get(unit, self.batch)]
            results = self._run_batch(unit, [works[number] for number in numbers])
            if results is None:
                self._batches[unit] = len(numbers) // 2
                continue
            for number, result in zip(numbers, results, strict=True):
                works[number] = replace(works[number], results=(*works[number].results, result))
            waiting = waiting[len(numbers) :]
        return works

    def _run_batch(self, unit: Unit, works: list[PairWork]) -> list[UnitResult] | None:
        """The results of a batch; ``None`` where memory was short and fewer pairs may fit."""
        try:
            return self._match_batch(unit, works)
        except Exception as error:  # whatever a matcher raises costs these pairs this unit, not the run
            failure = failure_of(error)
            if failure is Failure.ORDINARY:
                lost = UnitResult(unit, Matches.empty(), failure=reason_of(error))
                return [lost for _ in works]
            if failure is Failure.DEVICE or len(works) == 1:
                error.add_note(f"in {unit.name}")
                raise
        # Not in the handler: until it is left, the error's traceback holds the tensors of the batch.
        release_memory()
        return None

    def _match_batch(self, unit: Unit, works: list[PairWork]) -> list[UnitResult]:
        matcher = self._matcher(unit.matcher)
        views = [views_of(unit, matcher.spec, work) for work in works]
        start = time.perf_counter()
        wanted = [
            (image, view)
            for work, pair in zip(works, views, strict=True)
            for image, view in zip(work.images, pair, strict=True)
        ]
        encodings = self._encode(unit, wanted)
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

    def _encode(self, unit: Unit, wanted: Sequence[tuple[Image, View]]) -> list[Any]:
        """The encodings of views by the unit's matcher, from the cache or made now, one shape together."""
        name, size = unit.matcher, self._batches.get(unit, self.batch)
        matcher = self._matcher(name)
        keys = [(name, image.name, view) for image, view in wanted]
        known = {key: self._encodings.get(key) for key in keys}
        missing = {key: item for key, item in zip(keys, wanted, strict=True) if known[key] is None}
        by_shape: dict[Size, list[tuple[str, str, View]]] = {}
        for key in missing:
            by_shape.setdefault(key[2].padded, []).append(key)
        for alike in by_shape.values():
            for start in range(0, len(alike), size):
                batch = alike[start : start + size]
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


def release_memory() -> None:
    """Give the GPU the memory back that PyTorch keeps for later: cuBLAS and cuDNN cannot use it."""
    import torch

    torch.cuda.empty_cache()


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
    return conclude(work.results, work.regions, recipe, model, intrinsics)


def conclude(
    results: Iterable[UnitResult],
    regions: Regions | None,
    recipe: Recipe,
    model: Model = Model.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> PairMatch:
    """The two-view model from all matches of a pair, in the recipe's order: MAGSAC's result depends on it."""
    order = {unit: number for number, unit in enumerate(recipe.units)}
    ordered = tuple(sorted(results, key=lambda result: order[result.unit]))
    matches = Matches.concatenate(result.matches for result in ordered)
    return PairMatch(ordered, regions, estimate(matches, recipe.magsac, model, intrinsics))
