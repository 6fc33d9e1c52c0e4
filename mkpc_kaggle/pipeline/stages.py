"""The two-stage pipeline on a chunk of pairs.

Stage 1 matches whole images, MKPC finds the critical region of each, stage 2 matches the crops; the points of
both stages, in image pixels, are concatenated in the recipe's order, and MAGSAC does the rest, alone or under the
recipe's prior on focal lengths.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from mkpc_kaggle.geometry.critical_region import critical_region
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.units import ENCODING_CACHE_BYTES, UnitRunner
from mkpc_kaggle.recipe import Recipe, Unit


class Pipeline:
    """A recipe's units, run on chunks of pairs; see :class:`UnitRunner` for the arguments."""

    def __init__(
        self,
        recipe: Recipe,
        load: Callable[[str], Matcher[Any]],
        *,
        batch: int = 1,
        cache_bytes: int = ENCODING_CACHE_BYTES,
        load_float32: Callable[[str], Matcher[Any]] | None = None,
    ) -> None:
        self.recipe = recipe
        self.batch = batch
        self._runner = UnitRunner(load, batch, cache_bytes, load_float32)

    def load(self) -> None:
        """Load all matchers of the recipe now; raises :class:`UserError` where one cannot be."""
        for name in self.recipe.matcher_names:
            self._runner.matcher(name)

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
            pairs = self._run(unit, pairs, may_start)
        if any(unit.stage == 2 for unit in units):
            pairs = [with_regions(pair, self.recipe) for pair in pairs]
        for unit in (unit for unit in units if unit.stage == 2):
            pairs = self._run(unit, pairs, may_start)
        return pairs

    def _run(self, unit: Unit, pairs: list[PairMatch], may_start: Callable[[Unit], bool]) -> list[PairMatch]:
        pairs = list(pairs)
        waiting = [number for number, pair in enumerate(pairs) if not pair.has(unit)]
        while waiting and may_start(unit):
            batch = waiting[: self._runner.batch_of(unit)]
            results = self._runner.run(unit, [pairs[number] for number in batch])
            for number, result in zip(batch[: len(results)], results, strict=True):  # none where memory was short
                pairs[number] = replace(pairs[number], results=(*pairs[number].results, result))
            waiting = waiting[len(results) :]
        return pairs


def with_regions(pair: PairMatch, recipe: Recipe) -> PairMatch:
    """The pair with the critical region of each image, from the matched points of stage 1."""
    start = time.perf_counter()
    matches = pair.stage1_matches
    region0, region1 = (
        critical_region(points, image.size, recipe.mkpc)
        for points, image in zip((matches.points0, matches.points1), pair.images, strict=True)
    )
    return replace(pair, regions=(region0, region1), cluster_seconds=time.perf_counter() - start)
