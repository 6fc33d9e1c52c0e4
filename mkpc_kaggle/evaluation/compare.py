"""Recipes compared on the same pairs: differences of mAA with bootstrap intervals."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.evaluation.validate import Validation, to_json

LEVEL = 0.95
RESAMPLES = 10_000


@dataclass(frozen=True)
class Difference:
    """The gain of the second of two recipes over the first, and its confidence interval at :data:`LEVEL`."""

    gain: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.gain:+z.4f} [{self.low:+z.4f}, {self.high:+z.4f}]"


def paired_difference(scenes: Sequence[tuple[Sequence[float], Sequence[float]]]) -> Difference:
    """The mean over scenes of the mean gain on a pair, from the pairs' values under the first and second recipe.

    Both values of a pair have the same index. The interval is the percentile bootstrap's: the pairs of each
    scene are resampled with replacement, :data:`RESAMPLES` times; the scenes stay. It assumes independent pairs,
    which pairs that share an image are not quite. The same input gives the same interval. ``ValueError`` without
    scenes, for a scene without pairs, and if the two have different numbers of pairs.
    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 13.3.
    """
    if not scenes or any(len(first) != len(second) or not len(first) for first, second in scenes):
        raise ValueError("a comparison needs scenes, and each with the same pairs under both recipes")
    generator = np.random.default_rng(0)
    gains = [np.asarray(second, np.float64) - np.asarray(first, np.float64) for first, second in scenes]
    means = np.mean([_means_of_resamples(gain, generator) for gain in gains], axis=0)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Difference(mean(float(gain.mean()) for gain in gains), float(low), float(high))


def _means_of_resamples(gains: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """(RESAMPLES,) means of as many pairs as there are, drawn with replacement."""
    # Accuracies are multiples of 0.1: drawing the count of each value is equivalent to drawing pairs, and faster.
    values, counts = np.unique(gains.round(12), return_counts=True)
    drawn = generator.multinomial(len(gains), counts / len(gains), size=RESAMPLES)
    return np.asarray(drawn @ values / len(gains))


@dataclass(frozen=True)
class Comparison:
    """Validations of the same pairs; each is compared with the first."""

    validations: tuple[Validation, ...]

    def __post_init__(self) -> None:
        known = [[[pair.id for pair in scene.pairs] for scene in run.scenes] for run in self.validations]
        if any(ids != known[0] for ids in known):
            raise ValueError("the recipes ran on different pairs")

    def difference(self, number: int, scene: str | None = None) -> Difference:
        """MAA of the validation of that number less the first's, in a scene or as the mean over scenes."""
        runs = self.validations[0], self.validations[number]
        values = [[part.accuracies() for part in run.scenes if scene in (None, part.scene)] for run in runs]
        return paired_difference([*zip(*values, strict=True)])


def seconds_per_pair(validation: Validation) -> float:
    """Mean seconds of units, clustering and last estimate, over all runs of the journal; NaN if unknown."""
    records = validation.report.records if validation.report else ()
    seconds = (r.encode_seconds + r.match_seconds + r.cluster_seconds + r.estimate_seconds for r in records)
    return mean(seconds) if records else nan


def comparison_table(comparison: Comparison) -> list[str]:
    """Lines: mAA and seconds a pair of each recipe, then its gain over the first, in each scene and overall."""
    first, *others = comparison.validations
    lines = [f"{'recipe':<40}{'mAA':>9}{'seconds a pair':>16}"]
    lines += [f"{run.recipe:<40}{run.maa():>9.4f}{seconds_per_pair(run):>16.3f}" for run in comparison.validations]
    counts = {scene.scene: len(scene.pairs) for scene in first.scenes}
    for number, other in enumerate(others, start=1):
        lines += ["", f"{other.recipe} against {first.recipe}: gain of mAA, {LEVEL:.0%} interval"]
        for name in (*counts, None):
            count = counts[name] if name else sum(counts.values())
            lines.append(f"{name or 'mean over scenes':<20}{count:>6}  {comparison.difference(number, name)}")
    return lines


def step_gains(validation: Validation) -> list[str]:
    """Lines: the gain of mAA, as the mean over scenes, of each step over the step before; none without metres."""
    scenes = [scene for scene in validation.scenes if scene.in_metres]
    lines = []
    for steps in pairwise(validation.steps if scenes else ()):
        before, after = ([scene.accuracies(step) for scene in scenes] for step in steps)
        difference = paired_difference([*zip(before, after, strict=True)])
        lines.append(f"gain of {steps[1]} over the step before, {LEVEL:.0%} interval: {difference}")
    return lines


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """All figures as JSON values: each validation, and the gain of each later validation over the first."""

    def gain(number: int, name: str | None = None) -> dict[str, float]:
        difference = comparison.difference(number, name)
        return {"mAA": difference.gain, "low": difference.low, "high": difference.high}

    first, *others = comparison.validations
    runs = [{**to_json(run), "work_seconds_per_pair": seconds_per_pair(run)} for run in comparison.validations]
    gains = []
    for number, other in enumerate(others, start=1):
        scenes = [{"scene": scene.scene, **gain(number, scene.scene)} for scene in first.scenes]
        gains.append({"recipe": other.recipe, "against": first.recipe, **gain(number), "scenes": scenes})
    return {"recipes": runs, "level": LEVEL, "gains": gains}
