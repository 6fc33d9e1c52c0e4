"""Comparison of recipes on the same pairs: differences of mAA with bootstrap intervals."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan
from statistics import mean
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.evaluation.validate import Validation, to_json

LEVEL = 0.95
RESAMPLES = 10_000

# Values of the same pairs under two recipes, and the two images of each pair.
Paired: TypeAlias = tuple[Sequence[float], Sequence[float], Sequence[tuple[str, str]]]


@dataclass(frozen=True)
class Difference:
    """The gain of the second of two recipes over the first, and its confidence interval at :data:`LEVEL`."""

    gain: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.gain:+z.4f} [{self.low:+z.4f}, {self.high:+z.4f}]"


def paired_difference(scenes: Sequence[Paired]) -> Difference:
    """Return the gain, averaged over each scene's pairs and then over scenes, with its confidence interval.

    Pairs that share an image are not independent. So the bootstrap resamples images, not pairs: each image of a
    scene gets a random weight, and the product of two image weights is a pair's weight. Scenes are not resampled.
    The same input gives the same interval. If pairs share no image, the interval is up to 1.7 times too wide.
    Sources: Rubin 1981 (exponential weights); Owen 2007 (products of weights).
    """
    generator = np.random.default_rng(0)
    gains = [np.asarray(second, np.float64) - np.asarray(first, np.float64) for first, second, _ in scenes]
    means = [_resampled_means(gain, scene[2], generator) for gain, scene in zip(gains, scenes, strict=True)]
    low, high = np.quantile(np.mean(means, axis=0), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Difference(mean(float(gain.mean()) for gain in gains), float(low), float(high))


def _resampled_means(
    gains: NDArray[np.float64], images: Sequence[tuple[str, str]], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return weighted means (RESAMPLES,) of the gains (P,), one for each random draw of image weights."""
    _, ends = np.unique(np.array(images), return_inverse=True)
    ends = ends.reshape(-1, 2)
    table = np.zeros((2, ends.max() + 1, ends.max() + 1))  # by two images: sum of gains, number of pairs
    np.add.at(table[0], (ends[:, 0], ends[:, 1]), gains)
    np.add.at(table[1], (ends[:, 0], ends[:, 1]), 1.0)
    weights = generator.exponential(size=(RESAMPLES, table.shape[1]))
    total, count = ((weights @ each * weights).sum(axis=1) for each in table)
    return np.asarray(total / count)


def gain_of(other: Validation, first: Validation, scene: str | None = None) -> Difference:
    """Return the gain in mAA of ``other`` over ``first`` on the same pairs, in a scene or averaged over scenes."""
    both = zip(first.scenes, other.scenes, strict=True)
    return paired_difference(
        [(a.accuracies(), b.accuracies(), a.images) for a, b in both if scene in (None, a.scene)]
    )


def seconds_per_pair(validation: Validation) -> float:
    """Return the mean seconds per pair of units, clustering and last estimate in the journal; NaN if unknown."""
    records = validation.report.records if validation.report else ()
    seconds = (r.encode_seconds + r.match_seconds + r.cluster_seconds + r.estimate_seconds for r in records)
    return mean(seconds) if records else nan


def comparison_table(validations: Sequence[Validation]) -> list[str]:
    """Return lines: each recipe's mAA and seconds per pair, then its gain over the first, by scene and overall."""
    first, *others = validations
    lines = [f"{'recipe':<40}{'mAA':>9}{'seconds a pair':>16}"]
    lines += [f"{run.recipe:<40}{run.maa():>9.4f}{seconds_per_pair(run):>16.3f}" for run in validations]
    counts = {scene.scene: len(scene.pairs) for scene in first.scenes}
    for other in others:
        lines += ["", f"{other.recipe} against {first.recipe}: gain of mAA, {LEVEL:.0%} interval"]
        for name in (*counts, None):
            count = counts[name] if name else sum(counts.values())
            lines.append(f"{name or 'mean over scenes':<20}{count:>6}  {gain_of(other, first, name)}")
    return lines


def step_gains(validation: Validation) -> list[str]:
    """Return a line per step with the mean gain in mAA over the previous step. Skip scenes without metres."""
    scenes = [scene for scene in validation.scenes if scene.in_metres]
    lines = []
    for steps in pairwise(validation.steps if scenes else ()):
        first, second = steps
        difference = paired_difference([(s.accuracies(first), s.accuracies(second), s.images) for s in scenes])
        lines.append(f"gain of {second} over the step before, {LEVEL:.0%} interval: {difference}")
    return lines


def comparison_json(validations: Sequence[Validation]) -> dict[str, Any]:
    """Return all figures as JSON values: each validation, and each later one's gain over the first."""
    first, *others = validations

    def gain(other: Validation, name: str | None = None) -> dict[str, float]:
        difference = gain_of(other, first, name)
        return {"mAA": difference.gain, "low": difference.low, "high": difference.high}

    runs = [{**to_json(run), "work_seconds_per_pair": seconds_per_pair(run)} for run in validations]
    gains = []
    for other in others:
        scenes = [{"scene": scene.scene, **gain(other, scene.scene)} for scene in first.scenes]
        gains.append({"recipe": other.recipe, "against": first.recipe, **gain(other), "scenes": scenes})
    return {"recipes": runs, "level": LEVEL, "gains": gains}
