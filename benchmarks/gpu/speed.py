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
from mkpc_kaggle.matchers.contract import Matcher, MatcherSpec, Picture, Placement, Precision
from mkpc_kaggle.matchers.dense import DenseMatcher
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.pipeline.assembly import CUDA_MINIBATCH
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import CACHE_SHARE, ENCODING_CACHE_BYTES, Pipeline
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.weights import WeightStore

# The most useful recipes first: what follows may not be reached.
RECIPES = ("light", "best", "auto", "permissive", "imc2022", "classical")
QUICK_RECIPES = ("light",)
PHOTOGRAPH = Size(1600, 1200)
SINGLE_PAIRS = 3  # of a round with one pair at a time
SINGLE = ("aliked_lightglue", "aliked")  # are measured with one pair at a time, too
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


@dataclass(frozen=True)
class Load:
    """A matcher that is loaded in each precision, for these cases."""

    cases: tuple[Case, ...]
    minibatch: int = CUDA_MINIBATCH


def loads_of(cases: Sequence[Case]) -> list[Load]:
    """Return the cases in the order of the measurements.

    First each matcher at its first size, then the other sizes, then ALIKED pair by pair: a slower
    GPU, on which the time is short, then has figures of every matcher.
    """
    groups: dict[tuple[str, tuple[tuple[str, Any], ...]], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.matcher, case.options), []).append(case)
    firsts = [Load((group[0],)) for group in groups.values()]
    others = [Load(tuple(group[1:])) for group in groups.values() if len(group) > 1]
    singles = [Load((group[0],), 1) for group in groups.values() if group[0].matcher in SINGLE]
    return [*firsts, *others, *singles]


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each case and precision."""
    cases = cases_of(QUICK_RECIPES if setup.quick else RECIPES)
    if setup.quick:
        # Its views have one size.
        cases = list({(case.matcher, case.options): case for case in cases[::-1]}.values())[::-1]
    for load in loads_of(cases):
        for precision in (Precision.FLOAT16, Precision.FLOAT32):
            part.check_time(needed=5.0 if setup.is_gpu else 0.0)
            _measure_load(part, load, precision, setup)
            _free(setup)


def _measure_load(part: Part, load: Load, precision: Precision, setup: Setup) -> None:
    """Add the rows of a matcher at one precision."""
    cases = load.cases
    facts = {"matcher": cases[0].name, "precision": str(precision)}
    try:
        weights, kind = _weights(cases[0], setup)
        # Without a network, there is no other precision.
        if kind == "none" and precision is not Precision.FLOAT32:
            return
        placement = Placement(setup.device, precision)
        matcher = load_matcher(cases[0].matcher, weights, _options(cases[0], setup), placement)
    except Exception as error:
        with part.row(**facts):
            raise error
    else:
        for case in cases:
            part.check_time(needed=5.0 if setup.is_gpu else 0.0)
            with part.row(matcher=case.name, precision=str(precision)) as row:
                row["minibatch"] = load.minibatch
                row.update(_seconds(case, matcher, load.minibatch, setup))
                row["weights"] = kind
            _free(setup)


def _seconds(case: Case, matcher: Matcher[Any], minibatch: int, setup: Setup) -> Row:
    """Return the seconds of a pair, and the peak memory."""
    unit = Unit(1, case.matcher, CUT_SIDE_PX) if setup.quick else case.unit
    watched = Watched(matcher)
    pipeline = Pipeline(
        Recipe((unit,)), lambda _: watched, minibatch=minibatch, cache_bytes=_cache_bytes(setup)
    )
    count = minibatch if minibatch > 1 else SINGLE_PAIRS
    warm_up = 1 if isinstance(matcher, ONE_BY_ONE) else count
    _matched(pipeline, unit, _pairs(warm_up, "warm-up"), setup)
    if setup.is_gpu:
        torch.cuda.reset_peak_memory_stats(setup.device)
    results = _matched(pipeline, unit, _pairs(count, "measured"), setup)
    encode = statistics.mean(result.encode_seconds for result in results)
    match = statistics.mean(result.match_seconds for result in results)
    row: Row = {"new": encode + match, "cached": match, "encode": encode}
    row["matches"] = round(statistics.mean(len(result.matches) for result in results))
    row["pictures at a time"] = watched.largest
    if setup.is_gpu:
        row["peak GB"] = torch.cuda.max_memory_allocated(setup.device) / 1e9
    return row


def _weights(case: Case, setup: Setup) -> tuple[WeightStore, str]:
    """Return the trained weights of a case if all of them are there, else seeded ones."""
    trained = WeightStore(setup.weights)
    slots = _spec(case).slots_for(_options(case, setup))
    if not slots:
        return trained, "none"
    if all(trained.file_of(slot) is not None for slot in slots):
        return trained, "trained"
    return SeededWeights(), "seeded"


def _spec(case: Case) -> MatcherSpec:
    return spec_of(case.matcher, "benchmark")


def _options(case: Case, setup: Setup) -> Any:
    """Return the matcher's options: the recipe's, in a rehearsal with few keypoints."""
    kind: Any = _spec(case).options
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
    return cv2.resize(load_sample_images().images[0], PHOTOGRAPH, interpolation=cv2.INTER_CUBIC)


def _matched(pipeline: Pipeline, unit: Unit, pairs: list[PairMatch], setup: Setup) -> list[Any]:
    """Return the unit's result on each pair. Raise the first failure."""
    results = [pair.results[0] for pair in pipeline.match(pairs, [unit])]
    setup.synchronise()
    for result in results:
        if result.failure:
            raise RuntimeError(result.failure)
    return results


class Watched:
    """A matcher that notes the largest number of pictures it could encode at a time."""

    def __init__(self, inner: Matcher[Any]) -> None:
        self.spec = inner.spec
        self.largest = 0
        self._inner = inner

    def encode(self, pictures: Sequence[Picture]) -> Sequence[Any]:
        encodings = self._inner.encode(pictures)
        self.largest = max(self.largest, len(pictures))
        return encodings

    def match(self, encodings0: Sequence[Any], encodings1: Sequence[Any]) -> Sequence[Any]:
        return self._inner.match(encodings0, encodings1)
