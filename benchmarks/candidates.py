"""Whether a scene's best candidate can be chosen without truth: judges compared by draws of images.

python -m benchmarks.candidates --train-dir DIR [DIR ...] --journals DIR [DIR ...] --facts FILE
    [--scenes NAME ...] [--confirm NAME ...] [--images 8 10 12] [--seeds 4] [--supports 0.1]
    [--true-edges] [--held-out] [--processes N]

Journals, the work directories of `validate --min-covisibility 0` (or with scenes, which match extra
pairs), provide the matches and each pair's own F. A candidate is a reconstruction whose tracks come
from all units (today's rule) or from a single one. With ``--supports`` further candidates have tracks
from all units, without edges of less support (``min_support`` of [scene]). With ``--true-edges`` one has
no wrong edges, by truth. All candidates have the same pairs, and the same matches and own F of a pair.

Each draw of images is mapped once, and its facts become a line of ``--facts``: accuracies by truth, and
everything that a judge may use. A further run maps only the draws that the file lacks. The tables
compare each judge with today's rule, with each single candidate and with the oracle, which chooses
by truth. ``--confirm`` names scenes that were not used to choose the judge; they get tables of their
own. ``chosen`` is the share of draws in which a judge takes the better of the candidates, among draws
in which they differ by more than ``TIE``. A last table counts verified edges that are wrong by truth.
``--held-out`` maps a second time without every fifth pair, for judges by these pairs.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from benchmarks.candidate_facts import ALL, MIN_RIGHT, TRUE, Draw, drawn, facts_of, read_journals
from benchmarks.candidate_judges import JUDGES, Facts, by_rotations, choice_of
from mkpc_kaggle.data.competition import TrainScene, read_train_side
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.scene.models import LOOSE_SIGMA

TIE = 0.005  # of mAA
SIGMAS = (0.01, 0.03, 0.1, LOOSE_SIGMA, 1.0, np.inf)  # upper bounds of classes, in model sizes
# Of the product's judge: today's rule wins unless another is nearer
MARGINS = (0.01, 0.02, 0.03, 0.05)


def maa(facts: Facts, name: str) -> float:
    return fmean(facts["candidates"][name]["accuracies"])


def oracle(facts: Facts) -> dict[str, float]:
    return {name: maa(facts, name) for name in facts["candidates"]}


def table(title: str, draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table: each rule's mAA by scene, its gain over today's rule, and how often
    it chooses the better candidate.
    """
    scenes = list(dict.fromkeys(facts["scene"] for facts in draws))
    counts = [f"{name} ({sum(each['scene'] == name for each in draws)})" for name in scenes]
    heads = [title, *counts, "mean", "gain over today's rule", "chosen", "of the oracle's"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    units = [name for name in draws[0]["candidates"] if name != ALL]
    rules: dict[str, Callable[[Facts], str]] = {"today's rule: all units": lambda _: ALL}
    for unit in units:
        rules[f"always {unit}"] = lambda _, unit=unit: unit  # type: ignore[misc]
    for name, judge in JUDGES.items():
        rules[name] = lambda facts, judge=judge: choice_of(judge(facts))  # type: ignore[misc]
    for margin in MARGINS:
        rules[f"rotations of own F, {margin:.0%} nearer"] = partial(by_rotations, margin=margin)
    rules["the oracle"] = lambda facts: choice_of(oracle(facts))
    most = gain_over_today(draws, rules["the oracle"])[0]
    for name, rule in rules.items():
        means = []
        for scene in scenes:
            means.append(fmean(maa(each, rule(each)) for each in draws if each["scene"] == scene))
        gain, text = gain_over_today(draws, rule)
        cells = [f"{value:.3f}" for value in (*means, fmean(means))]
        cells += [text, f"{share_chosen(draws, rule):.2f}", f"{gain / most:.2f}" if most else ""]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def edge_table(draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table of verified edges by scene and candidate."""
    heads = ["edges of", "verified", "wrong", "inliers", "on wrong edges", "px on right edges"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for scene in dict.fromkeys(facts["scene"] for facts in draws):
        found = [facts["candidates"] for facts in draws if facts["scene"] == scene]
        for name in found[0]:
            edges = [edge for candidates in found for edge in candidates[name].get("edges", ())]
            if not edges:
                continue
            wrong = [inliers for inliers, share, _ in edges if share < MIN_RIGHT]
            total = sum(inliers for inliers, _, _ in edges)
            pixels = median(distance for _, share, distance in edges if share >= MIN_RIGHT)
            counts = f"{len(edges)} | {len(wrong)} | {total} | {sum(wrong)} | {pixels:.2f}"
            lines.append(f"| {scene}, {name} | {counts} |")
    return lines


def sigma_table(draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table: what F of the cameras gains over F of the pair, by the larger sigma of
    the two centres, over the pairs of all candidates.
    """
    gains: dict[float, list[float]] = {upper: [] for upper in SIGMAS}
    loose: dict[str, list[float]] = defaultdict(list)
    for facts in draws:
        for name, candidate in facts["candidates"].items():
            pairs = zip(candidate["by_scene"], facts["own"], candidate["pair_sigmas"], strict=True)
            for scene, own, sigmas in pairs:
                if not sigmas:
                    continue
                sigma = max(each[1] if each else np.inf for each in sigmas)
                gains[next(upper for upper in SIGMAS if sigma <= upper)].append(scene - own)
                # A pair that keeps its own F gains nothing by it.
                if name == ALL:
                    loose[facts["scene"]].append(own - scene if sigma > LOOSE_SIGMA else 0.0)
    lines = ["| sigma up to | pairs | gain of the cameras' F |", "| --- | --- | --- |"]
    for upper, found in gains.items():
        if found:
            lines.append(f"| {upper:g} | {len(found)} | {fmean(found):+.3f} |")
    kept = ", ".join(f"{scene} {fmean(found):+.3f}" for scene, found in loose.items())
    return [
        *lines,
        "",
        f"today's rule, F of the pair above {LOOSE_SIGMA:g}, mean over pairs: {kept}",
    ]


def gain_over_today(draws: Sequence[Facts], rule: Callable[[Facts], str]) -> tuple[float, str]:
    """Return the gain of a rule in mAA, the mean over scenes, and a text with its interval.

    Draws and scenes are resampled.
    """
    first = []
    second = []
    ends = []
    for number, facts in enumerate(draws):
        first.append(maa(facts, ALL))
        second.append(maa(facts, rule(facts)))
        ends.append((facts["scene"], f"draw {number}"))
    difference = paired_difference([(first, second, ends)])
    return difference.gain, str(difference)


def share_chosen(draws: Sequence[Facts], rule: Callable[[Facts], str]) -> float:
    """Return in which share of the comparisons with a candidate the chosen one is the better."""
    right = []
    for facts in draws:
        chosen = rule(facts)
        for name in facts["candidates"]:
            gain = maa(facts, chosen) - maa(facts, name)
            if abs(gain) > TIE:
                right.append(gain > 0)
    return fmean(right) if right else np.nan


def read_facts(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def key_of(facts: Facts) -> tuple[str, int, int]:
    return facts["scene"], facts["images"], facts["seed"]


def draws_of(arguments: argparse.Namespace) -> Iterator[Draw]:
    """Yield the draws of all scenes that the journals have."""
    scenes: dict[str, TrainScene] = {}
    cameras: dict[str, dict[str, Camera]] = {}
    for directory in arguments.train_dir:
        for scene in read_train_side(directory, min_covisibility=0):
            of = cameras.setdefault(scene.name, {})
            for true in scene.pairs:
                of |= zip(true.pair.names, (true.camera0, true.camera1), strict=True)
        for scene in read_train_side(directory):
            if not arguments.scenes or scene.name in arguments.scenes:
                scenes[scene.name] = scene
    for name, (recipe, pairs) in read_journals(arguments.journals, scenes).items():
        units = [unit.name for unit in recipe.units if unit.tracks]
        supports = [f"{ALL}+{share:g}" for share in arguments.supports]
        true_edges = [ALL + TRUE] if arguments.true_edges else []
        number = len({image for pair in pairs for image in pair.names})
        for images in arguments.images:
            # All images of a scene make a single draw.
            seeds = arguments.seeds if 0 < images < number else 1
            for seed in range(seeds):
                yield Draw(
                    scenes[name],
                    images,
                    seed,
                    recipe,
                    tuple(drawn(pairs, images, seed)),
                    (ALL, *units, *supports, *true_edges),
                    cameras[name],
                    arguments.held_out,
                )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, nargs="+", required=True)
    parser.add_argument("--journals", type=Path, nargs="+", default=())
    parser.add_argument("--facts", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument("--confirm", nargs="*", default=())
    parser.add_argument("--images", nargs="+", type=int, default=[8, 10, 12])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--supports", nargs="*", type=float, default=(0.1,))
    parser.add_argument("--true-edges", action="store_true")
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    done = {key_of(facts) for facts in read_facts(arguments.facts)}
    tasks = [draw for draw in draws_of(arguments) if draw.key not in done]
    # All scenes in turns, so that a run that is cut off has draws of all.
    tasks.sort(key=lambda draw: (draw.seed, draw.images))
    # A new process for each draw, since pycolmap's memory does not return.
    pool = ProcessPoolExecutor(arguments.processes, get_context("spawn"), max_tasks_per_child=1)
    with pool, arguments.facts.open("a", encoding="utf-8") as stream:
        for future in as_completed([pool.submit(facts_of, draw) for draw in tasks]):
            # Infinite errors are Python's JSON.
            stream.write(json.dumps(future.result()) + "\n")
            stream.flush()
    # In a fixed order, whatever process was first
    draws = sorted(read_facts(arguments.facts), key=key_of)
    draws = [each for each in draws if not arguments.scenes or each["scene"] in arguments.scenes]
    groups: dict[str, list[Facts]] = defaultdict(list)
    for facts in draws:
        groups["confirmed on" if facts["scene"] in arguments.confirm else "chosen on"].append(facts)
    if len(groups) > 1:
        groups["all"] = [*draws]
    for title, group in groups.items():
        print("\n".join(table(title, group)), "\n", flush=True)
    print("\n".join([*edge_table(draws), "", *sigma_table(draws)]), flush=True)


if __name__ == "__main__":
    main()
