"""When a pair's own F replaces that of its scene: by the evidence of all units.

python -m benchmarks.pair_choice FACTS

FACTS is the file of ``benchmarks.candidates``. A share is the scene's evidence over that of the pair's own F
(:func:`mkpc_kaggle.scene.choose.evidence`), as the mean of the units. The first table has the accuracy of
both F by this share. The second has the gain if the pair keeps its F where the share is below a limit, over
the file's choice. "chosen" are the pairs of the candidate that the product takes; the others are of all
candidates. Draws are resampled.
"""

import argparse
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from benchmarks.candidate_facts import SCALES_PX
from benchmarks.candidate_judges import by_rotations
from benchmarks.candidates import read_facts
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.scene.candidates import MAX_SHARE
from mkpc_kaggle.scene.choose import EVIDENCE_MATCHES, EVIDENCE_PX, EVIDENCE_UNIT

SCALE = SCALES_PX.index(EVIDENCE_PX)
CLASSES = (0.1, 0.3, 0.5, 0.7, 0.9, np.inf)  # upper ends
LIMITS = (0.3, 0.5, 0.7)


def share_of(own: dict[str, list[float]], scene: dict[str, list[float]]) -> float:
    """Return the scene's share of the evidence for the pair's F; infinite if this is little."""
    shares = [
        scene[unit][SCALE] / values[SCALE]
        for unit, values in own.items()
        if values[SCALE] >= EVIDENCE_UNIT
    ]
    is_enough = sum(values[SCALE] for values in own.values()) >= EVIDENCE_MATCHES
    return fmean(shares) if shares and is_enough else np.inf


def pairs_of(draws: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each pair of each candidate."""
    rows = []
    for number, facts in enumerate(draws):
        chosen = by_rotations(facts, 1 - MAX_SHARE)
        for name, candidate in facts["candidates"].items():
            for pair, reason in enumerate(candidate["reasons"]):
                rows.append(
                    {
                        "draw": f"draw {number}",
                        "scene": facts["scene"],
                        "is_chosen": name == chosen,
                        "has_both": reason in ("SCENE", "CONTRADICTION"),
                        "own": facts["own"][pair],
                        "by_scene": candidate["by_scene"][pair],
                        "used": candidate["accuracies"][pair],
                        "share": share_of(facts["own_evidence"][pair], candidate["evidence"][pair]),
                    }
                )
    return rows


def class_table(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["| share below | pairs | the pair's F | the scene's F |", "| --- | --- | --- | --- |"]
    lower = 0.0
    for upper in CLASSES:
        found = [row for row in rows if row["has_both"] and lower <= row["share"] < upper]
        lower = upper
        if found:
            own, scene = (fmean(row[key] for row in found) for key in ("own", "by_scene"))
            lines.append(f"| {upper:g} | {len(found)} | {own:.3f} | {scene:.3f} |")
    return lines


def rule_table(rows: list[dict[str, Any]]) -> list[str]:
    scenes = sorted({row["scene"] for row in rows})
    heads = ["limit", "pairs", "changed", "gain", *scenes]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for title, group in (
        ("all", rows),
        ("chosen", [row for row in rows if row["is_chosen"]]),
    ):
        for limit in LIMITS:
            changed = [row["has_both"] and row["share"] < limit for row in group]
            after = [
                row["own"] if is_changed else row["used"]
                for row, is_changed in zip(group, changed, strict=True)
            ]
            compared = []
            by_scene = []
            for scene in scenes:
                which = [n for n, row in enumerate(group) if row["scene"] == scene]
                first = [group[n]["used"] for n in which]
                second = [after[n] for n in which]
                # The end of a pair is its draw, since draws are resampled.
                ends = [(group[n]["draw"], group[n]["draw"]) for n in which]
                compared.append((first, second, ends))
                by_scene.append(f"{fmean(second) - fmean(first):+.4f}")
            gain = str(paired_difference(compared))
            cells = [f"{limit:g}, {title}", str(len(group)), str(sum(changed)), gain, *by_scene]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("facts", type=Path)
    rows = pairs_of(read_facts(parser.parse_args().facts))
    print("\n".join([*class_table(rows), "", *rule_table(rows)]), flush=True)


if __name__ == "__main__":
    main()
