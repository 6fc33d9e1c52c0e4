"""Gains of mAA by covisibility and by size of the crop, from the figures of `validate`.

python -m benchmarks.small_regions --train-dir DIR FIGURES.json

The file comes from `validate --compare ... --json`; the other recipes are compared with its first.
The share of a crop is its area over its image's, of the smaller of the pair's two crops, in the
first recipe that has crops. Intervals resample images.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from pathlib import Path
from statistics import mean
from typing import Any

from PIL import Image

from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.evaluation.compare import paired_difference

COVISIBILITIES = (0.1, 0.2, 0.4, inf)
SHARES = (0.0, 0.25, 0.5, 1.0, inf)  # the last bin has the pairs without a crop


@dataclass(frozen=True)
class Pair:
    """A scored pair: the accuracy by each recipe, and the values of the bins."""

    scene: str
    images: tuple[str, str]
    accuracies: tuple[float, ...]
    covisibility: float
    share: float  # 1 if both regions are the whole image


def share_of(boxes: Sequence[Sequence[int]], sizes: Sequence[tuple[int, int]]) -> float:
    """Return the area of the smaller crop relative to its image, 1 without crops."""
    shares = [1.0]
    # Not strict: a pair without crops has sizes, but no boxes.
    for (left, top, right, bottom), (width, height) in zip(boxes, sizes, strict=False):
        shares.append((right - left) * (bottom - top) / (width * height))
    return min(shares)


def read_pairs(train_dir: Path, recipes: Sequence[dict[str, Any]]) -> list[Pair]:
    """Return the compared pairs, from the figures of each recipe."""
    by_id = [
        {pair["pair"]: pair for scene in figures["scenes"] for pair in scene["pairs"]}
        for figures in recipes
    ]
    names = [scene["scene"] for scene in recipes[0]["scenes"]]
    pairs = []
    for scene in read_train_side(train_dir, scenes=names):
        for true in scene.pairs:
            # A comparison may have run on some of the pairs.
            if true.pair.id not in by_id[0]:
                continue
            rows = [table[true.pair.id] for table in by_id]
            # Of a two-stage recipe: the baselines have no regions, and then no box is compared.
            boxes = next((row["boxes"] for row in rows if row["boxes"]), [])
            sizes = [Image.open(path).size for path in true.pair.images]
            accuracies = tuple(last_accuracy(row) for row in rows)
            share = share_of(boxes, sizes)
            pairs.append(Pair(scene.name, true.pair.names, accuracies, true.covisibility, share))
    return pairs


def last_accuracy(row: dict[str, Any]) -> float:
    """Return the accuracy after the last step of the estimate."""
    # The keys are in the order of the run.
    return float(list(row["accuracy_by_step"].values())[-1])


def rows(
    pairs: Sequence[Pair], value: Callable[[Pair], float], edges: Sequence[float]
) -> list[str]:
    """Return a row for each bin of the value, from its lower edge on."""
    lines = []
    for low, high in pairwise(edges):
        inside = [pair for pair in pairs if low <= value(pair) < high]
        if not inside:
            continue
        name = f"{low:g} to {high:g}" if high < inf else f"{low:g} and more"
        maas = [
            mean(pair.accuracies[n] for pair in inside) for n in range(len(inside[0].accuracies))
        ]
        # Of the first recipe, the accuracy; of the others, the gain, too.
        cells = [f"{maas[0]:.3f}"]
        for number, maa in enumerate(maas[1:], start=1):
            cells.append(f"{maa:.3f}, {gain(inside, number)}")
        lines.append(f"| {name} | {len(inside)} | {' | '.join(cells)} |")
    return lines


def gain(pairs: Sequence[Pair], number: int) -> str:
    """Return the gain of a recipe over the first, with its interval over images."""
    before = [pair.accuracies[0] for pair in pairs]
    after = [pair.accuracies[number] for pair in pairs]
    # Images of two scenes may have one name.
    images = [
        (f"{pair.scene}/{pair.images[0]}", f"{pair.scene}/{pair.images[1]}") for pair in pairs
    ]
    return str(paired_difference([(before, after, images)]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("figures", type=Path)
    given = parser.parse_args()
    recipes = json.loads(given.figures.read_text(encoding="utf-8"))["recipes"]
    pairs = read_pairs(given.train_dir, recipes)
    heads = " | ".join(each["recipe"] for each in recipes)
    for title, value, edges in (
        ("covisibility", lambda pair: pair.covisibility, COVISIBILITIES),
        ("share of the smaller crop", lambda pair: pair.share, SHARES),
    ):
        print(f"| {title} | pairs | {heads} |")
        print("|" + " --- |" * (len(recipes) + 2))
        print("\n".join(rows(pairs, value, edges)), end="\n\n")


if __name__ == "__main__":
    main()
