"""Scores of F by MAGSAC, with a prior on focal lengths, and from cameras, on the same matches.

python -m benchmarks.estimation --train-dir DIR --journals DIR [DIR ...] [--scenes NAME ...]
    [--estimates NAME ...] [--thresholds PIXELS ...] [--settings TOML ...]
    [--images 18] [--seeds 8]

Journals, the work directories of `validate`, provide the matches and each pair's own F. A journal
made with ``--min-covisibility 0`` also has the extra pairs that a scene may add; they are not
scored.

The unit of evidence is a draw: some or all images of a scene. The output has a table for each
journal. Each row has an estimate's mAA by scene, gain over the first row, and CPU seconds per pair
or batch. Intervals resample images if each scene has one draw, and draws otherwise; the mean's
interval then also resamples scenes. ``--settings`` gives a row for each line of a recipe's table
[scene], such as "cameras = 'image'". ``--thresholds`` replaces the rows by two rows for each
threshold of MAGSAC.
"""

import argparse
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from statistics import mean
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.config import from_table
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.evaluation.validate import Difference, error_of, paired_difference
from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.sfm import reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

MIN_COVISIBILITY = 0.1  # of a scored pair, as in the competition
MAGSAC = RobustConfig()
# Names of estimates.
OWN = "own F"
SCENE = "scene"


@dataclass(frozen=True, eq=False)
class Known:
    """A pair with its matches and its own F from a journal; F is ``None`` for a failed estimate."""

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
    """Estimate F with a prior that knows the images' sizes only, not their EXIF."""
    size0, size1 = found.sizes
    priors = (FocalPrior.of_image(size0), FocalPrior.of_image(size1))
    return estimate_with_prior(found.matches, priors, magsac, FocalConfig())


def by_pair(make: Callable[[PairMatch], Estimate]) -> Estimator:
    """Return the estimator of each pair by itself."""

    # Draws have pairs in common.
    @cache
    def of_pair(known: Known) -> Matrix3 | None:
        found = make(known.found)
        return found.matrix if found.ok else None

    return lambda pairs, _: [of_pair(pair) for pair in pairs]


def by_threshold(pixels: float) -> dict[str, Estimator]:
    """Return the estimators without and with a prior at a threshold."""
    magsac = replace(MAGSAC, threshold=pixels)
    return {
        f"MAGSAC, {pixels:g} px": by_pair(lambda found: estimate(found.matches, magsac)),
        f"prior, {pixels:g} px": by_pair(lambda found: with_prior(found, magsac)),
    }


PAIR_ESTIMATORS: dict[str, Estimator] = {
    "MAGSAC": by_pair(lambda found: estimate(found.matches, MAGSAC)),
    "prior": by_pair(with_prior),
    OWN: lambda pairs, _: [pair.F for pair in pairs],
}


def by_scene(
    settings: str, pairs: Sequence[Known], every: Sequence[Known]
) -> list[Matrix3 | None]:
    """Return the F of pairs reconstructed as one batch, together with extra pairs."""
    config = from_table(SceneConfig, tomllib.loads(settings), settings)
    batch = [batch_pair(pair.true, pair.found, pair.F) for pair in pairs]
    for extra in extra_of(pairs, every, config):
        # The engine matches extra pairs by the first unit alone.
        first = replace(extra.found, results=extra.found.results[:1])
        batch.append(batch_pair(extra.true, first))
    choices = reconstruct_batch(batch, config).choices[: len(pairs)]
    matrices = []
    for pair, choice in zip(pairs, choices, strict=True):
        # As in a submission: without an F from the scene, the pair keeps its own.
        matrices.append(pair.F if choice.F is None else choice.F)
    return matrices


def batch_pair(true: TruePair, found: PairMatch, F: Matrix3 | None = None) -> BatchPair:
    """Return a pair as the input of a reconstruction."""
    name0, name1 = true.pair.names
    size0, size1 = found.sizes
    # The name stands for the digest of the content: a scene's images have different names.
    image0 = BatchImage(name0, name0, size0)
    image1 = BatchImage(name1, name1, size1)
    by_unit = tuple(result.matches for result in found.results)
    return BatchPair(image0, image1, by_unit, F, tracks_of(found.results))


def extra_of(
    pairs: Sequence[Known], every: Sequence[Known], config: SceneConfig
) -> list[Known]:
    """Return the extra pairs that the engine would add."""
    names = list(dict.fromkeys(name for pair in pairs for name in pair.names))
    number = {name: index for index, name in enumerate(names)}
    ends = []
    for pair in pairs:
        first, second = pair.names
        ends.append((number[first], number[second]))
    chosen = extra_pairs(len(names), ends, config.pairs_per_image)
    wanted = {frozenset((names[first], names[second])) for first, second in chosen}
    return [pair for pair in every if frozenset(pair.names) in wanted]


# Each pair's matches and own F by pair id
Journal: TypeAlias = dict[str, tuple[PairMatch, Matrix3 | None]]


def read_journal(directory: Path) -> tuple[str, Journal]:
    """Return the recipe's name and the pairs of a run."""
    with Store.read(directory) as store:
        query = "SELECT name, width, height FROM image"
        sizes = {name: Size(*size) for name, *size in store.db.execute(query)}
    tables = results(directory)
    # Others were never matched, or have an unreadable image.
    pairs = tables.pairs[tables.pairs["units"] > 0]
    found = {}
    for pair, match in zip(
        pairs.to_dict("records"), tables.matches(*pairs["pair"]), strict=True
    ):
        known = replace(match, sizes=(sizes[pair["image0"]], sizes[pair["image1"]]))
        F = None if pair["failure"] else np.reshape(pair["own"], (3, 3))
        found[pair["pair"]] = (known, F)
    return tables.recipe.name, found


@dataclass(frozen=True, eq=False)
class Score:
    """Result of an estimate on a draw of a scene, with the images of its pairs and CPU seconds."""

    accuracies: list[float]
    images: list[tuple[str, str]]
    seconds: float


def score(
    make: Estimator, pairs: Sequence[Known], every: Sequence[Known], scene: TrainScene
) -> Score:
    """Return the score of an estimator on the pairs of a draw."""
    start = time.process_time()
    matrices = make(pairs, every)
    seconds = time.process_time() - start
    accuracies = []
    for F, pair in zip(matrices, pairs, strict=True):
        error = PoseError.failed() if F is None else error_of(F, pair.true, scene)
        accuracies.append(pair_accuracy(error))
    return Score(accuracies, [pair.names for pair in pairs], seconds)


def drawn(every: Sequence[Known], images: int, seed: int) -> tuple[list[Known], list[Known]]:
    """Draw random images, or all if ``images`` is 0. Return their scored pairs, and all of them."""
    generator = np.random.default_rng(seed)
    # Sorted, because the order of a set differs between runs.
    names = sorted({name for pair in every for name in pair.names})
    chosen = set(generator.permutation(names)[: images or None].tolist())
    inside = [pair for pair in every if chosen >= set(pair.names)]
    return [pair for pair in inside if pair.true.covisibility >= MIN_COVISIBILITY], inside


# The score of each estimate, by scene and draw.
Draws: TypeAlias = Mapping[str, Sequence[Mapping[str, Score]]]


def difference(draws: Draws, first: str, second: str) -> Difference:
    """Return the gain of the second estimate over the first.

    Its interval is over images, or over draws if a scene has several.
    """
    if all(len(scores) == 1 for scores in draws.values()):
        single = []
        for (only,) in draws.values():
            before = only[first]
            after = only[second]
            single.append((before.accuracies, after.accuracies, before.images))
        return paired_difference(single)
    firsts: list[float] = []
    seconds: list[float] = []
    ends: list[tuple[str, str]] = []
    for scene, scores in draws.items():
        for each in scores:
            # Scene and draw take the place of two images: both are resampled.
            ends.append((scene, f"draw {len(ends)}"))
            firsts.append(mean(each[first].accuracies))
            seconds.append(mean(each[second].accuracies))
    return paired_difference([(firsts, seconds, ends)])


def table(title: str, draws: Draws, names: Sequence[str]) -> list[str]:
    """Return a Markdown table.

    A second row per estimate has gains by scene; lines below have gains by draw.
    """
    counts = [f"{name} ({len(scores)})" for name, scores in draws.items()]
    lines = [f"| {title} | {' | '.join(counts)} | mean | gain over the first | seconds |"]
    lines.append("|" + " --- |" * (len(counts) + 4))
    by_draw = []
    for name in names:
        maas = {}
        for scene, scores in draws.items():
            maas[scene] = [mean(each[name].accuracies) for each in scores]
        means = [mean(values) for values in maas.values()]
        cells = [f"{value:.3f}" for value in (*means, mean(means))]
        gain = "" if name == names[0] else str(difference(draws, names[0], name))
        lines.append(
            f"| {name} | {' | '.join(cells)} | {gain} | {_seconds(draws, name):.2f} |"
        )
        if gain:
            gains = []
            for scene, scores in draws.items():
                gains.append(str(difference({scene: scores}, names[0], name)))
            lines.append(f"| its gain | {' | '.join(gains)} | | | |")
        for scene, values in maas.items():
            first = [mean(each[names[0]].accuracies) for each in draws[scene]]
            shown = []
            for value, other in zip(values, first, strict=True):
                shown.append(f"{value - other:+.3f}" if gain else f"{value:.3f}")
            by_draw.append(f"{name}, {scene}: {', '.join(shown)}")
    if any(len(scores) > 1 for scores in draws.values()):
        lines += ["", *by_draw]
    return lines


def _seconds(draws: Draws, name: str) -> float:
    """Return an estimate's CPU seconds, per batch for scenes and per pair for all others."""
    scores = [each[name] for draw in draws.values() for each in draw]
    runs = len(scores)
    if not name.startswith(SCENE):
        runs = sum(len(each.accuracies) for each in scores)
    return sum(each.seconds for each in scores) / runs


def draws_of(
    scene: TrainScene,
    journal: Journal,
    estimators: Mapping[str, Estimator],
    images: int,
    seeds: int,
) -> list[dict[str, Score]]:
    """Return the scores of each draw of a scene by estimate; none if the journal has other scenes."""
    every = [
        Known(true, *journal[true.pair.id]) for true in scene.pairs if true.pair.id in journal
    ]
    if not every:
        return []
    draws = []
    # All images of a scene make a single draw.
    for seed in range(seeds if images else 1):
        pairs, inside = drawn(every, images, seed)
        draws.append(
            {name: score(make, pairs, inside, scene) for name, make in estimators.items()}
        )
    return draws


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--train-dir", type=Path, required=True)
    add("--journals", type=Path, nargs="+", required=True)
    add("--scenes", nargs="*", default=())
    add("--images", type=int, default=0, help="of a draw; 0, the default: all")
    add("--seeds", type=int, default=1, help="draws of each scene")
    add("--thresholds", type=float, nargs="+", default=())
    # The first is the one that the others are compared with.
    names = [*PAIR_ESTIMATORS, SCENE]
    add("--estimates", nargs="+", choices=names, default=names)
    add("--settings", nargs="+", default=[""], metavar="TOML")
    arguments = parser.parse_args()
    estimators = {
        name: PAIR_ESTIMATORS[name] for name in arguments.estimates if name != SCENE
    }
    if arguments.thresholds:
        estimators = {}
        for pixels in arguments.thresholds:
            estimators |= by_threshold(pixels)
    elif SCENE in arguments.estimates:
        for line in arguments.settings:
            name = f"{SCENE}, {line}" if line else SCENE
            estimators[name] = partial(by_scene, line)
    # Pairs without overlap, too: a scene may match them.
    scenes = read_train_side(arguments.train_dir, scenes=arguments.scenes, min_covisibility=0)
    for directory in arguments.journals:
        recipe, journal = read_journal(directory)
        found = {
            scene.name: draws_of(
                scene, journal, estimators, arguments.images, arguments.seeds
            )
            for scene in scenes
        }
        draws = {name: scores for name, scores in found.items() if scores}
        print("\n".join(table(recipe, draws, [*estimators])), "\n", flush=True)


if __name__ == "__main__":
    main()
