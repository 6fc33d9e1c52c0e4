"""The two-stage pipeline on a chunk of pairs.

Stage 1 matches whole images, MKPC finds the critical region of each, stage 2 matches the crops; the points of
both stages, in image pixels, are concatenated in the recipe's order, and MAGSAC does the rest.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from mkpc_kaggle.data.cache import ByteCache
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.critical_region import critical_region
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Colour, Matcher, MatcherSpec, Picture, encoding_bytes
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.pipeline.pair import PairMatch, Regions, UnitResult
from mkpc_kaggle.recipe import Recipe, Unit

ENCODING_CACHE_BYTES = 2 << 30


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
        self, pairs: Sequence[PairMatch], units: Iterable[Unit], may_start: Callable[[Unit], bool] = lambda _: True
    ) -> list[PairMatch]:
        """Run ``units`` on every pair that has not had them: stage 1, the critical regions, stage 2.

        ``may_start(unit)`` is asked before each unit on each batch of pairs; once it says no, what was found
        so far is returned. A unit that raises has failed on its batch, with the error as its reason; but errors of
        the device, and of memory that does not suffice for a single pair, are raised: see
        :mod:`mkpc_kaggle.pipeline.failures`.
        """
        pairs, units = list(pairs), list(units)
        for unit in (unit for unit in units if unit.stage == 1):
            pairs = self._run_unit(unit, pairs, may_start)
        if any(unit.stage == 2 for unit in units):
            pairs = [self._with_regions(pair) for pair in pairs]
        for unit in (unit for unit in units if unit.stage == 2):
            pairs = self._run_unit(unit, pairs, may_start)
        return pairs

    def _with_regions(self, pair: PairMatch) -> PairMatch:
        start = time.perf_counter()
        regions = regions_of(pair.stage1_matches, pair.images, self.recipe)
        return replace(pair, regions=regions, cluster_seconds=time.perf_counter() - start)

    def _run_unit(self, unit: Unit, pairs: list[PairMatch], may_start: Callable[[Unit], bool]) -> list[PairMatch]:
        pairs = list(pairs)
        waiting = [number for number, pair in enumerate(pairs) if not pair.has(unit)]
        while waiting and may_start(unit):
            numbers = waiting[: self._batches.get(unit, self.batch)]
            results = self._run_batch(unit, [pairs[number] for number in numbers])
            if results is None:
                self._batches[unit] = len(numbers) // 2
                continue
            for number, result in zip(numbers, results, strict=True):
                pairs[number] = replace(pairs[number], results=(*pairs[number].results, result))
            waiting = waiting[len(numbers) :]
        return pairs

    def _run_batch(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult] | None:
        """The results of a batch; ``None`` where memory was short and fewer pairs may fit."""
        try:
            return self._match_batch(unit, pairs)
        except Exception as error:  # whatever a matcher raises costs these pairs this unit, not the run
            failure = failure_of(error)
            if failure is Failure.ORDINARY:
                return [UnitResult(unit, Matches.empty(), failure=reason_of(error))] * len(pairs)
            if failure is Failure.DEVICE or len(pairs) == 1:
                error.add_note(f"in {unit.name}")
                raise
        # Not in the handler: until it is left, the error's traceback holds the tensors of the batch.
        release_memory()
        return None

    def _match_batch(self, unit: Unit, pairs: list[PairMatch]) -> list[UnitResult]:
        matcher = self._matcher(unit.matcher)
        both = [views_of(unit, matcher.spec, pair) for pair in pairs]
        start = time.perf_counter()
        wanted = [
            (image, view)
            for pair, views in zip(pairs, both, strict=True)
            for image, view in zip(pair.images, views, strict=True)
        ]
        encodings = self._encode(unit, wanted)
        encoded = time.perf_counter()
        found = matcher.match(encodings[::2], encodings[1::2])
        matched = time.perf_counter()
        return [
            UnitResult(
                unit,
                matches.to_image(*views).best(unit.max_matches),
                (encoded - start) / len(pairs),
                (matched - encoded) / len(pairs),
            )
            for matches, views in zip(found, both, strict=True)
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


def views_of(unit: Unit, spec: MatcherSpec, pair: PairMatch) -> tuple[View, View]:
    """What a unit looks at: whole images in stage 1, critical regions in stage 2."""
    if unit.stage == 1 or pair.regions is None:
        boxes = [Box.whole(image.size) for image in pair.images]
    else:
        boxes = [region.box for region in pair.regions]
    view0, view1 = (unit.view(box, spec.multiple) for box in boxes)
    if spec.same_size:
        common = Size(*map(max, view0.padded, view1.padded))
        view0, view1 = replace(view0, padded=common), replace(view1, padded=common)
    return view0, view1


def picture_of(image: Image, view: View, colour: Colour) -> Picture:
    return Picture(view.render(image.gray if colour is Colour.GRAY else image.pixels), view)


def regions_of(matches: Matches, images: tuple[Image, ...], recipe: Recipe) -> Regions:
    """The critical region of each image, from the matched points of stage 1."""
    region0, region1 = (
        critical_region(points, image.size, recipe.mkpc)
        for points, image in zip((matches.points0, matches.points1), images, strict=True)
    )
    return region0, region1
