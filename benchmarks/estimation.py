"""F by MAGSAC, under a prior on focal lengths, and from the cameras of the batch, on the same matches.

python -m benchmarks.estimation --train-dir DIR --journals DIR [DIR ...] [--scenes NAME ...] [--seeds 1]
    [--shares 1 0.3 0.12] [--estimates NAME ...] [--pairs-per-image 0 5 10] [--thresholds PIXELS ...]

The matches are those of journals, work directories of `validate`; pairs that a journal lacks are left out. For
each journal and share of a scene's pairs, drawn by seed, a row for each estimate: mAA by scene and in the mean,
its gain over the first estimate with the 95 % interval of resampled pairs, and seconds of this process, a pair or
a batch. With a number of pairs for each image, the scene also has what the first unit found on extra pairs. With
thresholds of MAGSAC, there are two rows for each instead: MAGSAC alone, and the prior.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

import numpy as np
from tqdm import tqdm

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.engine.journal import JournalReader
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import SceneConfig, recipe_of
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.reconstruct import reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

MAGSAC = RobustConfig(permutations=1)
FOCAL = FocalConfig()


def with_prior(found: PairMatch, magsac: RobustConfig = MAGSAC) -> Estimate:
    size0, size1 = found.sizes
    priors = FocalPrior.of_image(size0, FOCAL), FocalPrior.of_image(size1, FOCAL)
    return estimate_with_prior(found.matches, priors, magsac, FOCAL)


PairEstimates = dict[str, Callable[[PairMatch], Estimate]]

PAIR_ESTIMATES: PairEstimates = {
    "MAGSAC, 8 permutations": lambda found: estimate(found.matches, RobustConfig(permutations=8)),
    "MAGSAC": lambda found: estimate(found.matches, MAGSAC),
    "prior": with_prior,
}
SCENE = "scene"  # the F of the batch's cameras, or that of the prior where the pair keeps its own


def by_threshold(pixels: float) -> PairEstimates:
    magsac = replace(MAGSAC, threshold=pixels)
    return {
        f"MAGSAC, {pixels:g} px": lambda found: estimate(found.matches, magsac),
        f"prior, {pixels:g} px": lambda found: with_prior(found, magsac),
    }


def read_journal(directory: Path) -> tuple[str, dict[str, PairMatch]]:
    """The recipe's name, and by the ids of pairs what was found on them."""
    with JournalReader(directory) as journal:
        recipe = recipe_of(journal.belongs_to()["recipe"], journal.about().recipe)
        units, pairs = {unit.name: unit for unit in recipe.units}, journal.pairs()
        records = [record for index, record in journal.records().items() if index < len(pairs) and record.sizes]
        found = {pairs[r.index].id: PairMatch(journal.results(r, units), sizes=r.sizes) for r in records}
    return recipe.name, found


@dataclass(frozen=True, eq=False)
class Estimated:
    """A pair with its matches, and by estimate its F (``None`` where it failed), its accuracy and seconds."""

    true: TruePair
    found: PairMatch
    matrices: Mapping[str, Matrix3 | None]
    accuracies: Mapping[str, float]
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Score:
    """What one estimate made of the chosen pairs of one scene: their accuracies, and seconds in all."""

    accuracies: tuple[float, ...]
    seconds: float


def accuracy(F: Matrix3 | None, true: TruePair, scene: TrainScene) -> float:
    return pair_accuracy(PoseError.failed() if F is None else error_of(F, true, scene))


def estimated(true: TruePair, found: PairMatch, scene: TrainScene, estimates: PairEstimates) -> Estimated:
    """A pair by every estimate of pairs that is wanted; the prior's is what a scene is compared with."""
    matrices: dict[str, Matrix3 | None] = {}
    seconds = {}
    for name, make in estimates.items():
        start = time.process_time()
        result = make(found)
        seconds[name] = time.process_time() - start
        matrices[name] = result.matrix if result.ok else None
    accuracies = {name: accuracy(F, true, scene) for name, F in matrices.items()}
    return Estimated(true, found, matrices, accuracies, seconds)


def batch_pair(true: TruePair, found: PairMatch, F: Matrix3 | None) -> BatchPair:
    """A pair as a reconstruction is given it."""
    ends = zip(true.pair.images, found.sizes, strict=True)
    image0, image1 = (BatchImage(path.stem, path.stem, size) for path, size in ends)
    return BatchPair(image0, image1, found.matches, F, tracks_of(found.results))


def by_scene(pairs: Sequence[Estimated], scene: TrainScene, extra: Sequence[Estimated] = ()) -> Score:
    """The accuracy of the pairs as one batch; of the ``extra`` pairs the first unit's matches join it."""
    batch = [batch_pair(pair.true, pair.found, pair.matrices["prior"]) for pair in pairs]
    swept = [(pair.true, replace(pair.found, results=pair.found.results[:1])) for pair in extra]
    batch += [batch_pair(true, found, None) for true, found in swept]
    start = time.process_time()
    choices = reconstruct_batch(batch, SceneConfig()).choices[: len(pairs)]
    seconds = time.process_time() - start
    matrices = [
        pair.matrices["prior"] if choice.F is None else choice.F
        for pair, choice in zip(pairs, choices, strict=True)
    ]
    return Score(tuple(accuracy(F, pair.true, scene) for F, pair in zip(matrices, pairs, strict=True)), seconds)


def extra_of(pairs: Sequence[Estimated], every: Sequence[Estimated], per_image: float) -> list[Estimated]:
    """The pairs that these lack to have ``per_image`` for each of their images, as the engine chooses them."""
    ends = [[path.stem for path in pair.true.pair.images] for pair in pairs]
    names = list(dict.fromkeys(name for pair in ends for name in pair))
    chosen = extra_pairs(len(names), [(names.index(a), names.index(b)) for a, b in ends], per_image)
    wanted = {frozenset((names[first], names[second])) for first, second in chosen}
    return [pair for pair in every if {path.stem for path in pair.true.pair.images} in wanted]


def drawn(pairs: Sequence[Estimated], share: float, seed: int) -> list[Estimated]:
    """That share of the pairs, in their order."""
    count = round(share * len(pairs))
    places = np.sort(np.random.default_rng(seed).choice(len(pairs), count, replace=False))
    return [pairs[place] for place in places]


def score_all(
    pairs: Sequence[Estimated], every: Sequence[Estimated], scene: TrainScene, names: Mapping[str, float]
) -> dict[str, Score]:
    """By estimate; ``names`` has the pairs for each image that a scene gets."""
    return {
        name: by_scene(pairs, scene, extra_of(pairs, every, per_image))
        if name.startswith(SCENE)
        else Score(tuple(pair.accuracies[name] for pair in pairs), sum(pair.seconds[name] for pair in pairs))
        for name, per_image in names.items()
    }


def table(title: str, done: Mapping[str, Sequence[Mapping[str, Score]]], names: Sequence[str]) -> list[str]:
    """Markdown; ``done``: by scene, for each seed the scores by estimate, whose pairs count together."""
    joined = {
        name: {
            scene: [value for scores in seeds for value in scores[name].accuracies]
            for scene, seeds in done.items()
        }
        for name in names
    }
    counts = [f"{scene} ({len(values)})" for scene, values in joined[names[0]].items()]
    lines = [f"| {title} | {' | '.join(counts)} | mean | gain over the first | seconds |"]
    lines.append("|" + " --- |" * (len(counts) + 4))
    for name in names:
        means = [mean(values) for values in joined[name].values()]
        cells = " | ".join(f"{value:.3f}" for value in (*means, mean(means)))
        spent = [scores[name] for seeds in done.values() for scores in seeds]
        runs = len(spent) if name.startswith(SCENE) else sum(len(score.accuracies) for score in spent)
        seconds = sum(score.seconds for score in spent) / runs
        gain = str(paired_difference(list(zip(joined[names[0]].values(), joined[name].values(), strict=True))))
        lines.append(f"| {name} | {cells} | {'' if name == names[0] else gain} | {seconds:.2f} |")
        if name != names[0]:
            gains = [str(paired_difference([(joined[names[0]][scene], joined[name][scene])])) for scene in done]
            lines.append(f"| its gain | {' | '.join(gains)} | | | |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--journals", type=Path, nargs="+", required=True)
    parser.add_argument("--thresholds", type=float, nargs="+")
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument("--shares", nargs="+", type=float, default=[1.0])
    parser.add_argument("--seeds", type=int, default=1, help="samples of each share below 1")
    names = [*PAIR_ESTIMATES, SCENE]
    parser.add_argument("--estimates", nargs="+", choices=names, default=names)
    parser.add_argument("--pairs-per-image", nargs="+", type=float, default=[0.0])
    arguments = parser.parse_args()
    wanted = {name: make for name, make in PAIR_ESTIMATES.items() if name in (*arguments.estimates, "prior")}
    chosen_names = {name: 0.0 for name in arguments.estimates if name != SCENE}
    if arguments.thresholds:
        wanted = {name: make for pixels in arguments.thresholds for name, make in by_threshold(pixels).items()}
        chosen_names = dict.fromkeys(wanted, 0.0)
    elif SCENE in arguments.estimates:
        counts = arguments.pairs_per_image
        chosen_names |= {f"{SCENE}, {count:g} pairs an image" if count else SCENE: count for count in counts}
    for directory in arguments.journals:
        recipe, known = read_journal(directory)
        done: dict[float, dict[str, list[dict[str, Score]]]] = defaultdict(lambda: defaultdict(list))
        for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
            pairs = [
                estimated(true, known[true.pair.id], scene, wanted)
                for true in tqdm(scene.pairs, desc=f"{recipe}, {scene.name}", smoothing=0.05)
                if true.pair.id in known
            ]
            for share in arguments.shares:
                for seed in range(arguments.seeds if share < 1 else 1):
                    if chosen := drawn(pairs, share, seed):
                        done[share][scene.name].append(score_all(chosen, pairs, scene, chosen_names))
        for share, by_name in done.items():
            lines = table(f"{recipe}, {share:.0%} of the pairs", by_name, list(chosen_names))
            print("\n".join(lines), "\n", flush=True)


if __name__ == "__main__":
    main()
