"""Recipes compared on the same pairs: differences of mAA with bootstrap intervals."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.evaluation.validate import SceneScore, Step, Validation, to_json
from mkpc_kaggle.geometry.metrics import pair_accuracy

LEVEL = 0.95
RESAMPLES = 10_000

Values = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """The gain of the second of two recipes over the first, and its confidence interval at :data:`LEVEL`."""

    gain: float
    low: float
    high: float

    @property
    def significant(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0 or self.high < 0

    def __str__(self) -> str:
        return f"{self.gain:+z.4f} [{self.low:+z.4f}, {self.high:+z.4f}]"


def paired_difference(scenes: Sequence[tuple[Values, Values]], *, seed: int = 0) -> Difference:
    """The mean over scenes of the mean gain on a pair, from the pairs' values under the first and second recipe.

    Both values of a pair have the same index. The interval is the percentile bootstrap's: the pairs of each
    scene are resampled with replacement, :data:`RESAMPLES` times; the scenes stay. It assumes independent pairs,
    which those that share an image are not quite. The same input gives the same interval.
    ``ValueError`` without scenes, for a scene without pairs, and where the two have different pairs.
    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 13.3.
    """
    if not scenes:
        raise ValueError("no scenes to compare on")
    generator = np.random.default_rng(seed)
    gains = [_gains(first, second) for first, second in scenes]
    means = np.mean([_means_of_resamples(gain, generator) for gain in gains], axis=0)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Difference(mean(float(gain.mean()) for gain in gains), float(low), float(high))


def _gains(first: Values, second: Values) -> NDArray[np.float64]:
    if len(first) != len(second):
        raise ValueError(f"{len(first)} and {len(second)} values for the pairs of a scene")
    if len(first) == 0:
        raise ValueError("a scene has no pairs")
    return np.asarray(second, np.float64) - np.asarray(first, np.float64)


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
        known = [[[pair.id for pair in scene.pairs] for scene in one.scenes] for one in self.validations]
        if any(ids != known[0] for ids in known):
            raise ValueError("the recipes ran on different pairs")

    @property
    def scenes(self) -> tuple[str, ...]:
        """Those that have pairs."""
        return tuple(scene.scene for scene in self.validations[0].scenes if scene.pairs)

    def difference(self, number: int, scene: str | None = None) -> Difference:
        """MAA of the validation of that number less the first's, in a scene or as the mean over scenes."""
        names = self.scenes if scene is None else (scene,)
        first, second = self.validations[0], self.validations[number]
        return paired_difference([(accuracies(first, name), accuracies(second, name)) for name in names])


def accuracies(validation: Validation, scene: str) -> list[float]:
    """The accuracy of each pair of a scene, whose mean is the mAA."""
    return [pair_accuracy(error) for error in _scene(validation, scene).errors]


def _scene(validation: Validation, name: str) -> SceneScore:
    return next(scene for scene in validation.scenes if scene.scene == name)


def seconds_of_work(record: PairRecord) -> float:
    """Seconds of a pair's units, clustering and last estimate, over all runs of its journal."""
    units = record.encode_seconds + record.match_seconds
    return units + record.cluster_seconds + record.estimate_seconds


def seconds_per_pair(validation: Validation) -> float:
    """Mean seconds of work; NaN without records."""
    return mean(map(seconds_of_work, validation.records)) if validation.records else nan


def comparison_table(comparison: Comparison) -> list[str]:
    """Lines: mAA and seconds a pair of each recipe, then its gain over the first, in each scene and overall."""
    first, *others = comparison.validations
    lines = [f"{'recipe':<40}{'mAA':>9}{'seconds a pair':>16}"]
    lines += [f"{one.recipe:<40}{one.maa:>9.4f}{seconds_per_pair(one):>16.3f}" for one in comparison.validations]
    for number, other in enumerate(others, start=1):
        lines += ["", f"{other.recipe} against {first.recipe}: gain of mAA, {LEVEL:.0%} interval"]
        for name in comparison.scenes:
            pairs = len(_scene(first, name).pairs)
            lines.append(f"{name:<20}{pairs:>6}  {comparison.difference(number, name)}")
        total = sum(len(scene.pairs) for scene in first.scenes)
        lines.append(f"{'mean over scenes':<20}{total:>6}  {comparison.difference(number)}")
    return lines


def step_gains(validation: Validation) -> list[str]:
    """Lines: the gain of mAA, as the mean over scenes, of each step over the one before; none without metres."""
    scenes = [scene for scene in validation.scenes if scene.pairs]
    if not scenes or not all(scene.in_metres for scene in scenes):
        return []
    lines = []
    for former, step in pairwise(validation.steps):
        gains = paired_difference([(_after(scene, former), _after(scene, step)) for scene in scenes])
        lines.append(f"gain of {step} over the step before, {LEVEL:.0%} interval: {gains}")
    return lines


def _after(scene: SceneScore, step: Step) -> list[float]:
    return [pair_accuracy(pair.steps[step]) for pair in scene.pairs]


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """All figures as JSON values: each validation, and each one's gain over the first."""
    first, *others = comparison.validations
    return {
        "recipes": [
            {**to_json(one), "work_seconds_per_pair": seconds_per_pair(one)} for one in comparison.validations
        ],
        "level": LEVEL,
        "gains": [
            {
                "recipe": other.recipe,
                "against": first.recipe,
                **_difference_json(comparison.difference(number)),
                "scenes": [
                    {"scene": name, **_difference_json(comparison.difference(number, name))}
                    for name in comparison.scenes
                ],
            }
            for number, other in enumerate(others, start=1)
        ],
    }


def _difference_json(difference: Difference) -> dict[str, float]:
    return {"mAA": difference.gain, "low": difference.low, "high": difference.high}
