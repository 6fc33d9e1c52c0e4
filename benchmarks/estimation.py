"""Scores of F by MAGSAC, with a prior on focal lengths, and from a batch's cameras, on the same
matches.

python -m benchmarks.estimation --train-dir DIR --journals DIR [DIR ...] [--scenes NAME ...]
    [--estimates NAME ...] [--thresholds PIXELS ...] [--settings TOML ...] [--units A,B ...]
    [--images 18 24] [--shares 1 0.3 0.12] [--seeds 8]

Journals, the work directories of `validate`, provide the matches and each pair's own F. A journal made with
``--min-covisibility 0`` also has the extra pairs that a scene may add; they are not scored.

The unit of evidence is a draw: some or all images of a scene, and a share of their pairs. The
output has a table for each journal and share. Each row has an estimate's mAA by scene, gain over
the first estimate, and CPU seconds per pair or batch. Intervals resample images if each scene has
one draw, and draws otherwise; the mean's interval then also resamples scenes. ``--settings`` gives
a row for each line of a recipe's table [scene], such as "cameras = 'image'". ``--units`` gives a
row for each choice of the journal's units, such as ``1:sift@1536,1:aliked_lightglue@1024-``; a unit
with a minus connects images but makes no tracks. F of a pair is then estimated anew, from these
units. ``--thresholds`` replaces the rows by two rows for each threshold of MAGSAC.
"""

import argparse
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from statistics import mean
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.config import from_table
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.engine.records import Table, read_images, read_points, read_records
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.evaluation.compare import Difference, paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import SceneConfig, recipe_of
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.reconstruct import reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

MIN_COVISIBILITY = 0.1  # of a scored pair
MAGSAC = RobustConfig(permutations=1)
FOCAL = FocalConfig()
OWN, SCENE = "own F", "scene"


@dataclass(frozen=True, eq=False)
class Known:
    """A pair with its matches and its own F from a journal; F is ``None`` if the estimate failed."""

    true: TruePair
    found: PairMatch
    F: Matrix3 | None

    @property
    def names(self) -> tuple[str, str]:
        return self.true.pair.names


# Returns the F of the pairs in the first list; the second list has all pairs of their images in the
# journal.
Estimator: TypeAlias = Callable[[Sequence[Known], Sequence[Known]], Sequence[Matrix3 | None]]


def with_prior(found: PairMatch, magsac: RobustConfig = MAGSAC) -> Estimate:
    size0, size1 = found.sizes
    priors = FocalPrior.of_image(size0), FocalPrior.of_image(size1)
    return estimate_with_prior(found.matches, priors, magsac, FOCAL)


def by_pair(make: Callable[[PairMatch], Estimate]) -> Estimator:
    @cache
    def of_pair(known: Known) -> Matrix3 | None:
        found = make(known.found)
        return found.matrix if found.ok else None

    return lambda pairs, _: [of_pair(pair) for pair in pairs]


def by_threshold(pixels: float) -> dict[str, Estimator]:
    magsac = replace(MAGSAC, threshold=pixels)
    return {
        f"MAGSAC, {pixels:g} px": by_pair(lambda found: estimate(found.matches, magsac)),
        f"prior, {pixels:g} px": by_pair(lambda found: with_prior(found, magsac)),
    }


PAIR_ESTIMATORS: dict[str, Estimator] = {
    "MAGSAC, 8 permutations": by_pair(lambda found: estimate(found.matches, RobustConfig())),
    "MAGSAC": by_pair(lambda found: estimate(found.matches, MAGSAC)),
    "prior": by_pair(with_prior),
    OWN: lambda pairs, _: [pair.F for pair in pairs],
}


def with_units(known: Known, choice: str) -> Known:
    """Return the pair with the results of the chosen units, in their order, and F from them.

    Raises :class:`KeyError` for a unit that the journal does not have.
    """
    by_name = {result.unit.name: result for result in known.found.results}
    results = []
    for name in choice.split(","):
        result = by_name[name.removesuffix("-")]
        makes_tracks = result.unit.tracks and not name.endswith("-")
        results.append(replace(result, unit=replace(result.unit, tracks=makes_tracks)))
    found = replace(known.found, results=tuple(results))
    made = with_prior(found)
    return Known(known.true, found, made.matrix if made.ok else None)


def of_units(choice: str, make: Estimator) -> Estimator:
    """Return the estimator on the matches of the chosen units."""
    chosen = cache(partial(with_units, choice=choice))
    return lambda pairs, every: make([*map(chosen, pairs)], [*map(chosen, every)])


def by_scene(settings: str, pairs: Sequence[Known], every: Sequence[Known]) -> list[Matrix3 | None]:
    """Return the F of pairs reconstructed as one batch, together with the first unit's matches of
    extra pairs.
    """
    config = from_table(SceneConfig, tomllib.loads(settings), settings)
    batch = [batch_pair(pair.true, pair.found, pair.F) for pair in pairs]
    for extra in extra_of(pairs, every, config):
        batch.append(batch_pair(extra.true, replace(extra.found, results=extra.found.results[:1])))
    choices = reconstruct_batch(batch, config).choices[: len(pairs)]
    return [
        pair.F if choice.F is None else choice.F
        for pair, choice in zip(pairs, choices, strict=True)
    ]


def batch_pair(true: TruePair, found: PairMatch, F: Matrix3 | None = None) -> BatchPair:
    """Return a pair as the input of a reconstruction."""
    image0, image1 = (
        BatchImage(name, name, size)
        for name, size in zip(true.pair.names, found.sizes, strict=True)
    )
    return BatchPair(image0, image1, found.matches, F, tracks_of(found.results))


def extra_of(pairs: Sequence[Known], every: Sequence[Known], config: SceneConfig) -> list[Known]:
    """Return the extra pairs that the engine would add."""
    names = list(dict.fromkeys(name for pair in pairs for name in pair.names))
    ends = [
        (names.index(first), names.index(second))
        for first, second in (pair.names for pair in pairs)
    ]
    chosen = extra_pairs(len(names), ends, config.pairs_per_image)
    wanted = {frozenset((names[first], names[second])) for first, second in chosen}
    return [pair for pair in every if frozenset(pair.names) in wanted]


def read_journal(directory: Path) -> tuple[str, dict[str, tuple[PairMatch, Matrix3 | None]]]:
    """Return the recipe's name, and each pair's matches and own F by pair id."""
    with Store.read(directory) as store:
        published = Table.of(store)
        table = dict(published.about.recipe)
        recipe = recipe_of(table, table.pop("name"))
        units, found = {unit.name: unit for unit in recipe.units}, {}
        for record in (record for record in read_records(store, published) if record.units):
            images = read_images(store, published.rows[record.index])
            points = read_points(store, published, record.index)
            results = tuple(UnitResult(units[name], matches) for name, matches in points.items())
            match = PairMatch(results, sizes=tuple(image.size for image in images))
            found[record.pair.id] = match, None if record.failure else record.pair_fundamental
    return recipe.name, found


@dataclass(frozen=True, eq=False)
class Score:
    """Result of an estimate on a draw of a scene: accuracies of the pairs, images of the pairs,
    total seconds.
    """

    accuracies: list[float]
    images: list[tuple[str, str]]
    seconds: float


def score(
    make: Estimator, pairs: Sequence[Known], every: Sequence[Known], scene: TrainScene
) -> Score:
    start = time.process_time()
    matrices = make(pairs, every)
    seconds = time.process_time() - start
    errors = [
        PoseError.failed() if F is None else error_of(F, pair.true, scene)
        for F, pair in zip(matrices, pairs, strict=True)
    ]
    return Score([*map(pair_accuracy, errors)], [pair.names for pair in pairs], seconds)


def drawn(
    every: Sequence[Known], images: int, share: float, seed: int
) -> tuple[list[Known], list[Known]]:
    """Draw random images, or all if ``images`` is 0. Return a share of their scored pairs, and all
    their pairs.
    """
    generator = np.random.default_rng(seed)
    names = sorted({name for pair in every for name in pair.names})
    chosen = set(generator.permutation(names)[: images or None].tolist())
    inside = [pair for pair in every if chosen >= set(pair.names)]
    scored = [pair for pair in inside if pair.true.covisibility >= MIN_COVISIBILITY]
    kept = np.sort(generator.permutation(len(scored))[: round(share * len(scored))])
    return [scored[index] for index in kept], inside


# The score of each estimate, by scene and draw.
Draws: TypeAlias = Mapping[str, Sequence[Mapping[str, Score]]]


def difference(draws: Draws, first: str, second: str) -> Difference:
    """Return the gain of the second estimate over the first, with its interval over images or over
    draws.
    """
    both = [
        (scene, each[first], each[second]) for scene, scores in draws.items() for each in scores
    ]
    if len(both) == len(draws):
        return paired_difference([(a.accuracies, b.accuracies, a.images) for _, a, b in both])
    firsts, seconds = (
        [mean(a.accuracies) for _, a, _ in both],
        [mean(b.accuracies) for *_, b in both],
    )
    return paired_difference(
        [(firsts, seconds, [(scene, f"draw {n}") for n, (scene, *_) in enumerate(both)])]
    )


def table(title: str, draws: Draws, names: Sequence[str]) -> list[str]:
    """Return a Markdown table. A second row per estimate has gains by scene; lines below have gains
    by draw.
    """
    counts = [f"{name} ({len(scores)})" for name, scores in draws.items()]
    lines = [f"| {title} | {' | '.join(counts)} | mean | gain over the first | seconds |"]
    lines.append("|" + " --- |" * (len(counts) + 4))
    by_draw = []
    for name in names:
        maas = {
            scene: [mean(each[name].accuracies) for each in scores]
            for scene, scores in draws.items()
        }
        means = [mean(values) for values in maas.values()]
        spent = [each[name] for scores in draws.values() for each in scores]
        runs = len(spent) if name.startswith(SCENE) else sum(len(each.accuracies) for each in spent)
        cells = [f"{value:.3f}" for value in (*means, mean(means))]
        gain = "" if name == names[0] else str(difference(draws, names[0], name))
        lines.append(
            f"| {name} | {' | '.join(cells)} | {gain} | {sum(each.seconds for each in spent) / runs:.2f} |"
        )
        if gain:
            gains = [
                str(difference({scene: scores}, names[0], name)) for scene, scores in draws.items()
            ]
            lines.append(f"| its gain | {' | '.join(gains)} | | | |")
        for scene, values in maas.items():
            first = [mean(each[names[0]].accuracies) for each in draws[scene]]
            shown = [
                f"{value - other:+.3f}" if gain else f"{value:.3f}"
                for value, other in zip(values, first, strict=True)
            ]
            by_draw.append(f"{name}, {scene}: {', '.join(shown)}")
    return lines + (["", *by_draw] if any(len(scores) > 1 for scores in draws.values()) else [])


def main() -> None:
    parser = draws_parser(__doc__ or "")
    parser.add_argument("--thresholds", type=float, nargs="+", default=())
    names = [*PAIR_ESTIMATORS, SCENE]
    parser.add_argument("--estimates", nargs="+", choices=names, default=names)
    parser.add_argument("--settings", nargs="+", default=[""], metavar="TOML")
    parser.add_argument("--units", nargs="+", default=(), metavar="A,B")
    arguments = parser.parse_args()
    estimators = {name: PAIR_ESTIMATORS[name] for name in arguments.estimates if name != SCENE}
    if arguments.thresholds:
        estimators = {
            name: make
            for pixels in arguments.thresholds
            for name, make in by_threshold(pixels).items()
        }
    elif SCENE in arguments.estimates:
        settings = arguments.settings
        estimators |= {
            f"{SCENE}, {line}" if line else SCENE: partial(by_scene, line) for line in settings
        }
    if arguments.units:
        estimators = {
            f"{name}, {choice}": of_units(choice, make)
            for name, make in estimators.items()
            for choice in arguments.units
        }
    compare(estimators, arguments)


def draws_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser of the options that choose journals, scenes and draws."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--journals", type=Path, nargs="+", required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument(
        "--images", nargs="+", type=int, default=[0], help="of a draw; 0, the default: all"
    )
    parser.add_argument("--shares", nargs="+", type=float, default=[1.0])
    parser.add_argument(
        "--seeds", type=int, default=1, help="draws of each number of images and share"
    )
    return parser


def compare(estimators: Mapping[str, Estimator], arguments: argparse.Namespace) -> None:
    """Print a table of the estimators' scores for each journal and share."""
    for directory in arguments.journals:
        recipe, journal = read_journal(directory)
        done: dict[float, dict[str, list[dict[str, Score]]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for scene in read_train_side(
            arguments.train_dir, scenes=arguments.scenes, min_covisibility=0
        ):
            every = [
                Known(true, *journal[true.pair.id])
                for true in scene.pairs
                if true.pair.id in journal
            ]
            plan = (
                [*product(arguments.shares, arguments.images, range(arguments.seeds))]
                if every
                else []
            )
            for share, images, seed in plan:
                if seed and not images and share == 1:
                    continue  # all images of a scene make a single draw
                pairs, inside = drawn(every, images, share, seed)
                scores = {
                    name: score(make, pairs, inside, scene) for name, make in estimators.items()
                }
                done[share][scene.name].append(scores)
        for share, draws in done.items():
            title = f"{recipe}, {share:.0%} of the pairs"
            print("\n".join(table(title, draws, list(estimators))), "\n", flush=True)


if __name__ == "__main__":
    main()
