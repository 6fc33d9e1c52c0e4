"""MAGSAC on eight orders beside one order under a prior on focal lengths, on the same matches.

python -m benchmarks.estimation --train-dir DIR --matches DIR [--recipe classical] [--scenes A,B] [--every N]

Matches of the recipe are found once and kept, a file for each pair; then every pair is estimated in all ways,
alternating, in this process. For each way: mAA by scene and seconds a pair; for each but the first, its gain over
the first with the 95 % interval of resampled pairs.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import numpy as np
from tqdm import tqdm

from mkpc_kaggle.data.competition import Scene, TruePair, read_train_side
from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import Pipeline


@dataclass(frozen=True, eq=False)
class Found:
    """The matches of a pair, and the sizes of its images."""

    matches: Matches
    sizes: tuple[Size, Size]


Way = Callable[[Found], Estimate]


def plain(orders: int) -> Way:
    return lambda found: estimate(found.matches, RobustConfig(orders=orders))


def with_prior(orders: int, config: FocalConfig) -> Way:
    def way(found: Found) -> Estimate:
        size0, size1 = found.sizes
        priors = FocalPrior.of_image(size0, config), FocalPrior.of_image(size1, config)
        return estimate_with_prior(found.matches, priors, RobustConfig(orders=orders), config)

    return way


def ways_of(config: FocalConfig) -> dict[str, Way]:
    """By name; the first is what the others are compared with."""
    return {
        "MAGSAC, 8 orders": plain(8),
        "MAGSAC, 1 order": plain(1),
        "1 order and prior": with_prior(1, config),
    }


@dataclass(frozen=True)
class Outcome:
    """What one way made of one pair."""

    accuracy: float
    seconds: float
    origin: str


def matches_of(true: TruePair, pipeline: Pipeline, directory: Path, images: dict[Path, Image]) -> Found:
    """From the file of the pair, or found now and kept there. Images that were read are put into ``images``."""
    path = directory / true.pair.group / f"{true.pair.image0.stem}-{true.pair.image1.stem}.npz"
    if not path.exists():
        for image_path in true.pair.images:
            if image_path not in images:
                image = read_image(image_path)
                if isinstance(image, Unreadable):
                    raise SystemExit(str(image))
                images[image_path] = image
        pair = PairMatch(images=(images[true.pair.image0], images[true.pair.image1]))
        (pair,) = pipeline.match([pair], pipeline.recipe.units)
        order = {unit: number for number, unit in enumerate(pipeline.recipe.units)}
        results = sorted(pair.results, key=lambda result: order[result.unit])
        matches = Matches.concatenate(result.matches for result in results)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        with part.open("wb") as stream:
            np.savez(
                stream,
                points0=matches.points0,
                points1=matches.points1,
                scores=matches.scores,
                size0=pair.images[0].size,
                size1=pair.images[1].size,
            )
        part.replace(path)
    with np.load(path) as kept:
        size0, size1 = (Size(*map(int, kept[name])) for name in ("size0", "size1"))
        return Found(Matches(kept["points0"], kept["points1"], kept["scores"]), (size0, size1))


def try_all(
    found: Found, true: TruePair, scene: Scene, ways: Mapping[str, Way], number: int
) -> dict[str, Outcome]:
    """All ways on one pair; which comes first changes with the ``number`` of the pair."""
    names = list(ways)
    outcomes = {}
    for name in names[number % len(names) :] + names[: number % len(names)]:
        start = time.perf_counter()
        result = ways[name](found)
        seconds = time.perf_counter() - start
        error = error_of(result.matrix, true, scene) if result.ok else PoseError.failed()
        outcomes[name] = Outcome(pair_accuracy(error), seconds, str(result.origin) if result.ok else "failed")
    return {name: outcomes[name] for name in names}


def table(done: Mapping[str, Sequence[Mapping[str, Outcome]]], ways: Sequence[str]) -> list[str]:
    """Markdown: a row a way."""
    counts = [f"{scene} ({len(pairs)})" for scene, pairs in done.items()]
    lines = [f"| way | {' | '.join(counts)} | mean over scenes | seconds a pair | of the first's |"]
    lines.append("|" + " --- |" * (len(done) + 4))
    every = [pair for pairs in done.values() for pair in pairs]
    first = ways[0]
    for way in ways:
        scores = {scene: [pair[way].accuracy for pair in pairs] for scene, pairs in done.items()}
        means = [mean(values) for values in scores.values()]
        seconds = mean(pair[way].seconds for pair in every)
        share = seconds / mean(pair[first].seconds for pair in every)
        cells = [f"{value:.3f}" for value in (*means, mean(means))]
        lines.append(f"| {way} | {' | '.join(cells)} | {seconds:.3f} | {share:.2f} |")
        if way != first:
            values = [([pair[first].accuracy for pair in done[scene]], scores[scene]) for scene in done]
            gains = [str(paired_difference([value])) for value in values]
            lines.append(f"| its gain | {' | '.join(gains)} | {paired_difference(values)} | | |")
    lines.append("")
    for way in ways:
        lines.append(f"{way}: {dict(Counter(pair[way].origin for pair in every))}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True, help="where they are kept; made if it is not there")
    parser.add_argument("--recipe", default="classical")
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--scenes", default="", help="default: all")
    parser.add_argument("--every", type=int, default=1, help="of each scene's pairs; default: all of them")
    arguments = parser.parse_args()
    pipeline = assemble(arguments.recipe, weights=arguments.weights).pipeline()
    ways = ways_of(pipeline.recipe.focal or FocalConfig())
    done: dict[str, list[dict[str, Outcome]]] = {}
    for scene in read_train_side(arguments.train_dir, scenes=filter(None, arguments.scenes.split(","))):
        images: dict[Path, Image] = {}
        done[scene.name] = []
        for number, true in enumerate(tqdm(scene.pairs[:: arguments.every], desc=scene.name, smoothing=0.05)):
            found = matches_of(true, pipeline, arguments.matches, images)
            done[scene.name].append(try_all(found, true, scene, ways, number))
    print("\n".join(table(done, list(ways))))


if __name__ == "__main__":
    main()
