"""Judges of candidates: a value for each candidate of a draw. The highest wins, and today's rule wins
ties. For :mod:`benchmarks.candidates`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean, median
from typing import Any, TypeAlias

import numpy as np

from benchmarks.candidate_facts import ALL, SCALES_PX

MAX_ANGLE = 10.0  # degrees; larger disagreements count as this
Facts: TypeAlias = Mapping[str, Any]
Judge: TypeAlias = Callable[[Facts], Mapping[str, float]]


def by_share(facts: Facts, name: str, scale: int, pairs: Iterable[int], key: str) -> float:
    """Return the mean over pairs of the share of own F's evidence that a candidate has, each unit
    counted equally.
    """
    shares = []
    for number in pairs:
        own = facts["own_evidence"][number]
        # Keys of JSON objects are texts.
        table = facts["candidates"][name][key]
        scene = table[str(number)] if key == "held_out" else table[number]
        by_unit = []
        for unit, values in own.items():
            if values[scale] >= 5:  # fewer agree by chance
                by_unit.append(min(1.5, scene[unit][scale] / values[scale]))
        if by_unit:
            shares.append(fmean(by_unit))
    return fmean(shares) if shares else 0.0


def evidence_judge(scale: int, key: str) -> Judge:
    def judge(facts: Facts) -> dict[str, float]:
        candidates = facts["candidates"]
        numbers: list[int] = list(range(len(facts["pairs"])))
        if key == "held_out":
            numbers = [int(number) for number in candidates[ALL]["held_out"]]
        return {name: by_share(facts, name, scale, numbers, key) for name in candidates}

    return judge


def matches_judge(scale: int) -> Judge:
    """Judge by the sum of the evidence of all matches of all units."""

    def judge(facts: Facts) -> dict[str, float]:
        return {
            name: sum(values[scale] for pair in candidate["evidence"] for values in pair.values())
            for name, candidate in facts["candidates"].items()
        }

    return judge


def camera_sigmas(facts: Facts, name: str, which: int) -> list[float]:
    """Return one sigma of each image: infinite without a camera."""
    candidate = facts["candidates"][name]
    known = [each[which] if each else np.inf for each in candidate["sigmas"]]
    return known + [np.inf] * max(0, facts["present"] - len(known))


def sigma_judge(which: int) -> Judge:
    def judge(facts: Facts) -> dict[str, float]:
        return {name: -median(camera_sigmas(facts, name, which)) for name in facts["candidates"]}

    return judge


def capped(angles: Sequence[float]) -> float:
    return min(MAX_ANGLE, max(angles))


def own_judge(which: int | None) -> Judge:
    """Judge by the agreement of poses with those of the pairs' own F."""

    def judge(facts: Facts) -> dict[str, float]:
        values = {}
        for name, candidate in facts["candidates"].items():
            angles = [
                capped(both) if which is None else min(MAX_ANGLE, both[which])
                for both in candidate["own_apart"]
            ]
            values[name] = -fmean(angles)
        return values

    return judge


def agreement_judge(facts: Facts) -> dict[str, float]:
    """Judge by the agreement with the other candidates: the medoid."""
    values = {}
    for name, candidate in facts["candidates"].items():
        angles = []
        for pairs in candidate["apart"].values():
            angles += [MAX_ANGLE if both is None else capped(both) for both in pairs]
        values[name] = -fmean(angles)
    return values


def observations_judge(facts: Facts) -> dict[str, float]:
    return {name: float(sum(each["points"])) for name, each in facts["candidates"].items()}


def images_judge(facts: Facts) -> dict[str, float]:
    return {
        name: float(max(each["models"], default=0)) for name, each in facts["candidates"].items()
    }


JUDGES: dict[str, Judge] = {
    "most images": images_judge,
    "most observations": observations_judge,
    **{f"all matches, {scale:g} px": matches_judge(n) for n, scale in enumerate(SCALES_PX)},
    **{
        f"share of own F's, {scale:g} px": evidence_judge(n, "evidence")
        for n, scale in enumerate(SCALES_PX)
    },
    **{
        f"the same, pairs held out, {scale:g} px": evidence_judge(n, "held_out")
        for n, scale in enumerate(SCALES_PX)
    },
    "sigma of rotations": sigma_judge(0),
    "sigma of centres": sigma_judge(1),
    "sigma of focal lengths": sigma_judge(2),
    "rotations of own F": own_judge(0),
    "poses of own F": own_judge(None),
    "agreement of candidates": agreement_judge,
}


def choice_of(values: Mapping[str, float]) -> str:
    """Return the candidate with the highest value; of equal ones the first, today's."""
    return max(values, key=lambda name: values[name])


def by_rotations(facts: Facts, margin: float) -> str:
    """Return the choice of the product's judge (:mod:`mkpc_kaggle.scene.candidates`)."""
    angles = {name: -value for name, value in own_judge(0)(facts).items()}
    best = min(angles, key=lambda name: angles[name])
    return best if angles[best] < (1 - margin) * angles[ALL] else ALL
