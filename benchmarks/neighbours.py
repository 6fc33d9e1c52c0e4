"""Nearest neighbours of RootSIFT's descriptors by lists next to exact ones: scores and seconds.

python -m benchmarks.neighbours --train-dir DIR --scenes NAME ... [--long-side 1536] [--enlarge]
    [--probes 10 ...] [--orders 2] [--pairs N] [--images 18 --seeds 4]
python -m benchmarks.neighbours --train-dir DIR --scenes NAME --seconds 1000 2000 ...

Each pair is matched once by each search, with the matcher's settings of `classical`. A row has the
share of the exact matches that a search keeps, and of extra ones; CPU milliseconds to match a pair,
and to make the lists of an image; mAA of F from single pairs under the prior on focal lengths, and
its gain over exact search with an interval over images. MAGSAC depends on the order of the matches,
so a pair's accuracy is the mean over random orders, the same number for each search.

With `--images`, draws of that number of images are reconstructed as `reconstruct` does it, and rows
have the mAA of F from cameras; gains by draw follow. The gains of two rows are chance: the exact
matches in another order, and without one of 500, about the share that lists miss. With `--seconds`,
the first adjacent images are matched with these numbers of keypoints, and the output has
milliseconds alone.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import mean

import numpy as np
import torch

from benchmarks.estimation import (
    MIN_COVISIBILITY,
    SCENE,
    Draws,
    Known,
    Score,
    by_scene,
    drawn,
    score,
    table,
)
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size, View
from mkpc_kaggle.geometry.focal_prior import FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import pair_accuracy
from mkpc_kaggle.matchers import lists, neighbours
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.matchers.contract import Picture
from mkpc_kaggle.matchers.lists import Search
from mkpc_kaggle.matchers.sparse import Keypoints
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit, load_recipe

EXACT = "exact"
CONTROL = "exact, in another order"
THINNED = "exact, without 1 of 500"
RECIPE = load_recipe("classical")
OPTIONS = SiftOptions(**RECIPE.matchers["sift"])
MATCHER = SiftMatcher(OPTIONS, "cpu")
IN_LISTS = SiftMatcher(replace(OPTIONS, search=Search.LISTS), "cpu")


@dataclass(frozen=True, eq=False)
class Encoded:
    """An image's size and view, its keypoints, and the same keypoints in lists."""

    size: Size
    view: View
    exact: Keypoints
    listed: Keypoints


class Searches:
    """The images of a scene, and the matches of its pairs by each search."""

    def __init__(self, unit: Unit, probes: Sequence[int]) -> None:
        self.unit = unit
        self.names = {EXACT: 0, **{f"{count} probes": count for count in probes}}
        self.ms: dict[str, list[float]] = {name: [] for name in self.names}
        self.kept: dict[str, list[int]] = {name: [] for name in self.names}
        self.extra: dict[str, list[int]] = {name: [] for name in self.names}
        self.making: list[float] = []
        self._encoded: dict[Path, Encoded] = {}

    def of_pair(self, true: TruePair) -> dict[str, Known]:
        """Return the pair by each search, without an F."""
        first, second = (self._encode(file) for file in true.pair.images)
        wanted: set[tuple[float, ...]] = set()
        found = {}
        for name, probes in self.names.items():
            lists.PROBES = probes or lists.PROBES
            ends = (first.listed, second.listed) if probes else (first.exact, second.exact)
            begin = time.process_time()
            matches = MATCHER.match(ends[:1], ends[1:])[0]
            self.ms[name].append(1000 * (time.process_time() - begin))
            points = np.hstack([matches.points0, matches.points1])
            got = set(map(tuple, points.tolist()))
            wanted = wanted or got
            self.kept[name].append(len(got & wanted))
            self.extra[name].append(len(got - wanted))
            in_image = matches.to_image(first.view, second.view).best(self.unit.max_matches)
            sizes = (first.size, second.size)
            match = PairMatch((UnitResult(self.unit, in_image),), sizes=sizes)
            found[name] = Known(true, match, None)
        return found

    def _encode(self, file: Path) -> Encoded:
        if file not in self._encoded:
            image = read_image(file)
            assert isinstance(image, Image), image
            view = self.unit.view(Box.whole(image.size), multiple=1)
            (exact,) = MATCHER.encode([Picture(view.render(image.gray), view)])
            begin = time.process_time()
            listed = IN_LISTS._searchable(exact)
            self.making.append(1000 * (time.process_time() - begin))
            self._encoded[file] = Encoded(image.size, view, exact, listed)
        return self._encoded[file]

    def row(self, name: str) -> str:
        """Return the cells of a search: matches kept and extra, milliseconds."""
        exact = sum(self.kept[EXACT])
        kept = sum(self.kept[name]) / exact
        extra = sum(self.extra[name]) / exact
        return f"{kept:.3f} | {extra:.3f} | {mean(self.ms[name]):.0f} | {mean(self.making):.0f}"


def accuracy(known: Known, scene: TrainScene, orders: int) -> float:
    """Return the mean accuracy of F from a pair's matches over random orders of the matches."""
    size0, size1 = known.found.sizes
    priors = (FocalPrior.of_image(size0), FocalPrior.of_image(size1))
    found = []
    for seed in range(orders):
        matches = shuffled(known, seed).found.matches
        assert RECIPE.focal is not None
        made = estimate_with_prior(matches, priors, RECIPE.magsac, RECIPE.focal)
        error = error_of(made.matrix if made.ok else None, known.true, scene)
        found.append(pair_accuracy(error))
    return mean(found)


def single_pairs(
    scene: TrainScene, pairs: Sequence[dict[str, Known]], searches: Searches, orders: int
) -> None:
    """Print a row for each search."""
    images = [pair[EXACT].names for pair in pairs]
    exact: list[float] = []
    for name in searches.names:
        accuracies = [accuracy(pair[name], scene, orders) for pair in pairs]
        exact = exact or accuracies
        gain = "" if name == EXACT else paired_difference([(exact, accuracies, images)])
        cells = f"{scene.name} ({len(pairs)}) | {name} | {searches.row(name)}"
        print(f"| {cells} | {mean(accuracies):.4f} | {gain} |", flush=True)


def scene_draws(
    scene: TrainScene, searches: Searches, images: int, seeds: int
) -> list[dict[str, Score]]:
    """Return the scores of F from cameras by each search, for each draw of images."""
    stubs = [Known(true, PairMatch(), None) for true in scene.pairs]
    matched: dict[str, dict[str, Known]] = {}
    draws = []
    for seed in range(seeds):
        chosen, inside = drawn(stubs, images, 1.0, seed)
        for stub in inside:
            if stub.true.pair.id not in matched:  # in no former draw
                found = searches.of_pair(stub.true)
                found[CONTROL] = shuffled(found[EXACT])
                found[THINNED] = thinned(found[EXACT], seed=len(matched))
                matched[stub.true.pair.id] = found
        scores = {}
        for name in (EXACT, CONTROL, THINNED, *list(searches.names)[1:]):
            pairs = [matched[stub.true.pair.id][name] for stub in chosen]
            every = [matched[stub.true.pair.id][name] for stub in inside]
            scores[f"{SCENE}, {name}"] = score(_cameras, pairs, every, scene)
        draws.append(scores)
        shown = ", ".join(f"{name} {mean(each.accuracies):.4f}" for name, each in scores.items())
        print(f"{scene.name}, draw {seed}: {shown}", flush=True)
    return draws


def shuffled(known: Known, seed: int = 0) -> Known:
    """Return a pair with its matches in a random order."""
    (result,) = known.found.results
    order = np.random.default_rng(seed).permutation(len(result.matches))
    results = (replace(result, matches=result.matches[order]),)
    return replace(known, found=replace(known.found, results=results))


def thinned(known: Known, seed: int) -> Known:
    """Return a pair without a random 500th of its matches."""
    (result,) = known.found.results
    is_kept = np.random.default_rng(seed).random(len(result.matches)) > 1 / 500
    results = (replace(result, matches=result.matches[is_kept]),)
    return replace(known, found=replace(known.found, results=results))


def _cameras(pairs: Sequence[Known], every: Sequence[Known]) -> list[Matrix3 | None]:
    """Return F of the pairs from the cameras of all pairs of their images, as of a folder."""
    # Those that are not scored, too: a folder matches all pairs.
    inside = {pair.true.pair.id for pair in pairs}
    others = [pair for pair in every if pair.true.pair.id not in inside]
    return by_scene("pairs_per_image = 0", [*pairs, *others], ())[: len(pairs)]


def seconds(scene: TrainScene, unit: Unit, counts: Sequence[int]) -> None:
    """Print the milliseconds of both searches by the number of keypoints."""
    files = sorted({file for true in scene.pairs for file in true.pair.images})[:5]
    neighbours.MIN_KEYPOINTS = 1
    print("| keypoints | exact, ms | lists, ms | making, ms |\n|---|---|---|---|")
    searches = Searches(unit, ())
    for count in counts:
        ends = []
        for file in files:
            whole = searches._encode(file).exact
            kept = np.sort(np.random.default_rng(0).permutation(len(whole))[:count])
            ends.append(
                replace(whole, points=whole.points[kept], descriptors=whole.descriptors[kept])
            )
        begin = time.process_time()
        listed = [IN_LISTS._searchable(each) for each in ends]
        making = (time.process_time() - begin) / len(ends)
        best = {}
        for name, images in ((EXACT, ends), ("lists", listed)):
            taken = []
            for _ in range(5):
                begin = time.process_time()
                for first, second in pairwise(images):
                    MATCHER.match([first], [second])
                taken.append((time.process_time() - begin) / (len(images) - 1))
            best[name] = min(taken)
        print(
            f"| {count} | {1000 * best[EXACT]:.1f} | {1000 * best['lists']:.1f} | {1000 * making:.1f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", required=True)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--long-side", type=int, default=1536)
    parser.add_argument("--enlarge", action="store_true", help="enlarge smaller images")
    parser.add_argument("--probes", type=int, nargs="+", default=[lists.PROBES])
    parser.add_argument("--orders", type=int, default=2, help="of the matches; 0: no single pairs")
    parser.add_argument("--pairs", type=int, help="of a scene, evenly spread; default: all")
    parser.add_argument("--images", type=int, default=0, help="of a draw; 0: no scenes")
    parser.add_argument("--seeds", type=int, default=4, help="draws")
    parser.add_argument("--seconds", type=int, nargs="+", metavar="KEYPOINTS")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    unit = Unit(1, "sift", arguments.long_side, max_matches=8000, enlarge=arguments.enlarge)
    scenes = read_train_side(
        Path(arguments.train_dir),
        scenes=arguments.scenes,
        min_covisibility=0.0 if arguments.images else MIN_COVISIBILITY,
        pairs_per_scene=arguments.pairs,
    )
    if arguments.seconds:
        seconds(scenes[0], unit, arguments.seconds)
        return
    if arguments.orders:
        heads = "kept | extra | match, ms | lists, ms | mAA | gain"
        print(f"| scene (pairs) | search | {heads} |\n|" + "---|" * 8)
    by_scene_and_draw = {}
    for scene in scenes:
        searches = Searches(unit, arguments.probes)
        if arguments.orders:
            scored = [true for true in scene.pairs if true.covisibility >= MIN_COVISIBILITY]
            pairs = [searches.of_pair(true) for true in scored]
            single_pairs(scene, pairs, searches, arguments.orders)
        if arguments.images:
            by_scene_and_draw[scene.name] = scene_draws(
                scene, searches, arguments.images, arguments.seeds
            )
    if by_scene_and_draw:
        draws: Draws = by_scene_and_draw
        rows = list(next(iter(draws.values()))[0])
        print("\n" + "\n".join(table("cameras of draws", draws, rows)))


if __name__ == "__main__":
    main()
