"""Seconds of a pair and memory, for each matcher at the recipes' sizes.

A new pair encodes both of its images; of a cached pair, both encodings exist. Images are decoded
already. The matchers run in the pipeline of a run, with seeded weights, so that detectors find their
maximum of keypoints and LightGlue runs all its layers; with trained weights where they exist.
"""

import gc
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from sklearn.datasets import load_sample_images

from benchmarks.gpu.record import Part, Row
from benchmarks.gpu.seeded import SeededWeights
from benchmarks.gpu.setup import Setup
from mkpc_kaggle.config import from_table
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher
from mkpc_kaggle.matchers.contract import Matcher, Placement, Precision
from mkpc_kaggle.matchers.dense import DenseMatcher
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import CACHE_SHARE, ENCODING_CACHE_BYTES, Pipeline
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.setup.assembly import CUDA_MINIBATCH
from mkpc_kaggle.weights import WeightStore

# The most useful recipes first: what follows may not be reached.
RECIPES = ("light", "best", "auto", "permissive", "imc2022", "classical")
QUICK_RECIPES = ("light",)
PHOTOGRAPH = Size(1600, 1200)
ONE_BY_ONE = (DenseMatcher, SiftMatcher)  # their warm-up needs no minibatch
CUT_SIDE_PX = 160  # of a rehearsal's views
CUT_FEATURES = 256


@dataclass(frozen=True)
class Case:
    """A matcher with its options on views of one size."""

    matcher: str
    options: tuple[tuple[str, Any], ...]
    unit: Unit  # of stage 1

    @classmethod
    def of(cls, recipe: Recipe, unit: Unit) -> "Case":
        """Return the case that a recipe's unit belongs to."""
        options = tuple(sorted(recipe.matchers.get(unit.matcher, {}).items()))
        # The rest of a unit changes no cost.
        viewed = Unit(1, unit.matcher, unit.long_side, area=unit.area, stretch=unit.stretch)
        return cls(unit.matcher, options, viewed)

    @property
    def name(self) -> str:
        """The matcher and its view; the variant or the training, if it is not the default."""
        named = [str(value) for key, value in self.options if key in ("variant", "training")]
        matcher = " ".join([self.matcher, *named])
        return f"{matcher}@{self.unit.name.partition('@')[2]}"


def cases_of(recipes: Sequence[str]) -> list[Case]:
    """Return the cases of recipes, each once."""
    cases: dict[Case, None] = {}
    for name in recipes:
        recipe = load_recipe(name)
        for unit in recipe.units:
            cases[Case.of(recipe, unit)] = None
    return list(cases)


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each case and precision."""
    cases = cases_of(QUICK_RECIPES if setup.quick else RECIPES)
    if setup.quick:
        # Its views have one size.
        cases = [*{(case.matcher, case.options): case for case in cases}.values()]
    for case in cases:
        weights, kind = _weights(case, setup)
        # Without a network, there is no other precision.
        precisions = [Precision.FLOAT16, Precision.FLOAT32] if kind else [Precision.FLOAT32]
        for precision in precisions:
            part.check_time(needed=5.0 if setup.is_gpu else 0.0)
            with part.row(matcher=case.name, precision=str(precision), weights=kind) as row:
                placement = Placement(setup.device, precision)
                options = _options(case, setup)
                row.update(
                    _seconds(
                        load_matcher(case.matcher, weights, options, placement), case, setup
                    )
                )
            _free(setup)


def _seconds(matcher: Matcher[Any], case: Case, setup: Setup) -> Row:
    """Return the seconds of a pair in a minibatch, and the peak memory."""
    unit = Unit(1, case.matcher, CUT_SIDE_PX) if setup.quick else case.unit
    recipe = Recipe((unit,))
    cache_bytes = _cache_bytes(setup)
    pipeline = Pipeline(
        recipe, lambda _: matcher, minibatch=CUDA_MINIBATCH, cache_bytes=cache_bytes
    )
    warm_up = 1 if isinstance(matcher, ONE_BY_ONE) else CUDA_MINIBATCH
    _matched(pipeline, unit, _pairs(warm_up, "warm-up"), setup)
    if setup.is_gpu:
        torch.cuda.reset_peak_memory_stats(setup.device)
    results = _matched(pipeline, unit, _pairs(CUDA_MINIBATCH, "measured"), setup)
    encode = statistics.mean(result.encode_seconds for result in results)
    match = statistics.mean(result.match_seconds for result in results)
    row: Row = {"new": encode + match, "cached": match, "encode": encode}
    row["matches"] = round(statistics.mean(len(result.matches) for result in results))
    if setup.is_gpu:
        row["peak GB"] = torch.cuda.max_memory_allocated(setup.device) / 1e9
    return row


def _weights(case: Case, setup: Setup) -> tuple[WeightStore, str]:
    """Return the trained weights of a case if all of them are there, else seeded ones.

    And their kind, which is empty for a matcher without weights.
    """
    trained = WeightStore(setup.weights)
    slots = spec_of(case.matcher, "benchmark").slots_for(_options(case, setup))
    if all(trained.file_of(slot) is not None for slot in slots):
        return trained, "trained" if slots else ""
    return SeededWeights(), "seeded"


def _options(case: Case, setup: Setup) -> Any:
    """Return the matcher's options: the recipe's, in a rehearsal with few keypoints."""
    kind: Any = spec_of(case.matcher, "benchmark").options
    options = from_table(kind, dict(case.options), case.name)
    for name in ("features", "max_keypoints"):
        if setup.quick and hasattr(options, name):
            options = replace(options, **{name: CUT_FEATURES})
    return options


def _cache_bytes(setup: Setup) -> int:
    """Return the size of the cache of encodings, as a run chooses it."""
    if not setup.is_gpu:
        return ENCODING_CACHE_BYTES
    free, _ = torch.cuda.mem_get_info(setup.device)
    return int(free * CACHE_SHARE)


def _free(setup: Setup) -> None:
    """Return all unused memory to the device."""
    gc.collect()
    if setup.is_gpu:
        torch.cuda.empty_cache()


def _pairs(count: int, name: str) -> list[PairMatch]:
    """Return pairs of a photograph and its shifted copy; no image is in two pairs or two rounds."""
    pixels = _photograph()
    pairs = []
    for number in range(count):
        first = np.roll(pixels, 24 * number, axis=1)
        second = np.roll(first, (8, 16), axis=(0, 1))
        images = (Image(f"{name}, {number}, 0", first), Image(f"{name}, {number}, 1", second))
        pairs.append(PairMatch(images=images))
    return pairs


@cache
def _photograph() -> Any:
    return cv2.resize(
        load_sample_images().images[0], PHOTOGRAPH, interpolation=cv2.INTER_CUBIC
    )


def _matched(
    pipeline: Pipeline, unit: Unit, pairs: list[PairMatch], setup: Setup
) -> list[Any]:
    """Return the unit's result on each pair. Raise the first failure."""
    results = [pair.results[0] for pair in pipeline.match(pairs, [unit])]
    setup.synchronise()
    for result in results:
        if result.failure:
            raise RuntimeError(result.failure)
    return results
