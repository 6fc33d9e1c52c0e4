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

LEVEL = 0.95  # of confidence intervals
RESAMPLES = 10_000  # another seed moves the interval's ends by about a hundredth of its width

# Values of the same pairs under two recipes, and the two images of each pair.
Paired: TypeAlias = tuple[Sequence[float], Sequence[float], Sequence[tuple[str, str]]]


@dataclass(frozen=True)
class Difference:
    """The gain of the second of two recipes over the first, with its interval at :data:`LEVEL`."""

    gain: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.gain:+z.4f} [{self.low:+z.4f}, {self.high:+z.4f}]"


def paired_difference(scenes: Sequence[Paired]) -> Difference:
    """Return the gain with its confidence interval.

    The gain is averaged over each scene's pairs and then over scenes. Pairs that share an image are
    not independent. So the bootstrap resamples images, not pairs: each image of a scene gets a
    random weight, and the product of two image weights is a pair's weight. Scenes are not
    resampled. The same input gives the same interval. If pairs share no image, the interval is up
    to 1.7 times too wide. Sources: Rubin 1981 (exponential weights); Owen 2007 (products of
    weights).
    """
    generator = np.random.default_rng(0)  # a fixed seed: the same input, the same interval
    means: list[float] = []
    resampled: list[NDArray[np.float64]] = []
    for first, second, images in scenes:
        gains = np.asarray(second, np.float64) - np.asarray(first, np.float64)
        means.append(float(gains.mean()))
        resampled.append(_resampled_means(gains, images, generator))
    # Scenes count equally, as in the mAA, with few pairs or many.
    overall = np.mean(resampled, axis=0)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(overall, [tail, (1 + LEVEL) / 2])
    return Difference(mean(means), float(low), float(high))


def _resampled_means(
    gains: NDArray[np.float64], images: Sequence[tuple[str, str]], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return weighted means (RESAMPLES,) of the gains (P,), one for each draw of image weights."""
    names, ends = np.unique(np.array(images), return_inverse=True)
    first, second = ends.reshape(-1, 2).T  # (P,): the indices of each pair's images
    # Two tables by image and image, so that one product gives all resamples.
    gain_sums = np.zeros((len(names), len(names)))
    pair_counts = np.zeros((len(names), len(names)))
    # Not by indexing: a pair of images may be in the list twice, in two turns.
    np.add.at(gain_sums, (first, second), gains)
    np.add.at(pair_counts, (first, second), 1.0)
    weights = generator.exponential(size=(RESAMPLES, len(names)))
    # Row by row the quadratic form w^T A w: the sum of w_i w_j a_ij over all pairs.
    total = (weights @ gain_sums * weights).sum(axis=1)
    count = (weights @ pair_counts * weights).sum(axis=1)
    return np.asarray(total / count)


def gain_of(other: Validation, first: Validation, scene: str | None = None) -> Difference:
    """Return the gain in mAA of ``other`` over ``first`` on the same pairs.

    It is that of one scene, or the average over scenes.
    """
    paired: list[Paired] = []
    # Both have the same scenes and pairs, in the same order.
    for before, after in zip(first.scenes, other.scenes, strict=True):
        if scene in (None, before.scene):
            paired.append((before.accuracies(), after.accuracies(), before.images))
    return paired_difference(paired)


def seconds_per_pair(validation: Validation) -> float:
    """Return the mean seconds per pair of units, clustering and last estimate; NaN if unknown."""
    if validation.report is None:
        return nan
    # Not the decoding: it runs in parallel with matching.
    parts = ["encode_seconds", "match_seconds", "cluster_seconds", "estimate_seconds"]
    return float(validation.report.tables.pairs[parts].sum(axis="columns").mean())


def comparison_table(validations: Sequence[Validation]) -> list[str]:
    """Return lines: each recipe's mAA and seconds per pair, then its gain over the first.

    Gains are by scene and overall.
    """
    first, *others = validations
    lines = [f"{'recipe':<40}{'mAA':>9}{'seconds a pair':>16}"]
    for run in validations:
        lines.append(f"{run.recipe:<40}{run.maa():>9.4f}{seconds_per_pair(run):>16.3f}")
    counts = {scene.scene: len(scene.pairs) for scene in first.scenes}
    for other in others:
        lines.append("")
        lines.append(f"{other.recipe} against {first.recipe}: gain of mAA, {LEVEL:.0%} interval")
        for name, count in counts.items():
            lines.append(f"{name:<20}{count:>6}  {gain_of(other, first, name)}")
        total = sum(counts.values())
        lines.append(f"{'mean over scenes':<20}{total:>6}  {gain_of(other, first)}")
    return lines


def step_gains(validation: Validation) -> list[str]:
    """Return a line per step with the mean gain in mAA over the previous step.

    Scenes without metres are skipped.
    """
    scenes = [scene for scene in validation.scenes if scene.in_metres]
    if not scenes:
        return []
    lines = []
    for first, second in pairwise(validation.steps):
        paired = []
        for scene in scenes:
            paired.append((scene.accuracies(first), scene.accuracies(second), scene.images))
        difference = paired_difference(paired)
        lines.append(f"gain of {second} over the step before, {LEVEL:.0%} interval: {difference}")
    return lines


def comparison_json(validations: Sequence[Validation]) -> dict[str, Any]:
    """Return all figures as JSON values: validations, and gains of later ones over the first."""
    first, *others = validations

    def gain(other: Validation, name: str | None = None) -> dict[str, float]:
        difference = gain_of(other, first, name)
        return {"mAA": difference.gain, "low": difference.low, "high": difference.high}

    # ``to_json`` has the seconds of the run, which takes over units of the earlier runs.
    runs = [{**to_json(run), "work_seconds_per_pair": seconds_per_pair(run)} for run in validations]
    gains = []
    for other in others:
        scenes = []
        for scene in first.scenes:
            scenes.append({"scene": scene.scene, **gain(other, scene.scene)})
        names = {"recipe": other.recipe, "against": first.recipe}
        gains.append({**names, **gain(other), "scenes": scenes})
    return {"recipes": runs, "level": LEVEL, "gains": gains}
