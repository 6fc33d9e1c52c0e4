"""F by MAGSAC and under a prior on focal lengths, on the same matches: what the default of ``[focal]`` stands on.

python -m benchmarks.estimation --train-dir DIR --matches DIR --ways sift light xfeat+sift [--scenes NAME ...]

MATCHES is what `benchmarks.ways` wrote; A+B are the matches of both. Pairs without a file there are left out. For
each way a row for each estimate: mAA by scene and in the mean, its gain over the first estimate with the 95 %
interval of resampled pairs, and seconds of this process for a pair.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import mean

from tqdm import tqdm

from benchmarks import saved_matches
from benchmarks.saved_matches import SavedMatches
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig, estimate

MAGSAC = RobustConfig(permutations=1)
FOCAL = FocalConfig()

Score = tuple[float, float]  # of a pair: its accuracy, and seconds


def with_prior(found: SavedMatches) -> Estimate:
    size0, size1 = found.sizes
    priors = FocalPrior.of_image(size0, FOCAL), FocalPrior.of_image(size1, FOCAL)
    return estimate_with_prior(found.matches, priors, MAGSAC, FOCAL)


ESTIMATES: dict[str, Callable[[SavedMatches], Estimate]] = {
    "MAGSAC, 8 permutations": lambda found: estimate(found.matches, RobustConfig(permutations=8)),
    "MAGSAC": lambda found: estimate(found.matches, MAGSAC),
    "prior": with_prior,
}


def read(folder: Path, ways: Sequence[str], true: TruePair) -> SavedMatches | None:
    """The matches of all these ways together; ``None`` if a file is not there."""
    files = [saved_matches.file_of(folder / way, true) for way in ways]
    if not all(file.exists() for file in files):
        return None
    found = [saved_matches.read(file) for file in files]
    return SavedMatches(tuple(result for saved in found for result in saved.results), found[0].sizes)


def score(
    make: Callable[[SavedMatches], Estimate], found: SavedMatches, true: TruePair, scene: TrainScene
) -> Score:
    start = time.process_time()
    result = make(found)
    seconds = time.process_time() - start
    return pair_accuracy(error_of(result.matrix, true, scene) if result.ok else PoseError.failed()), seconds


def table(title: str, scores: Mapping[str, Mapping[str, Sequence[Score]]]) -> list[str]:
    """Markdown; ``scores``: by estimate and scene."""
    accuracies = {
        name: {scene: [accuracy for accuracy, _ in pairs] for scene, pairs in by_scene.items()}
        for name, by_scene in scores.items()
    }
    first = next(iter(accuracies.values()))
    counts = [f"{scene} ({len(values)})" for scene, values in first.items()]
    lines = [f"| {title} | {' | '.join(counts)} | mean | gain over the first | seconds |"]
    lines.append("|" + " --- |" * (len(counts) + 4))
    for name, by_scene in accuracies.items():
        means = [mean(values) for values in by_scene.values()]
        cells = " | ".join(f"{value:.3f}" for value in (*means, mean(means)))
        seconds = mean(spent for pairs in scores[name].values() for _, spent in pairs)
        gain = str(paired_difference(list(zip(first.values(), by_scene.values(), strict=True))))
        lines.append(f"| {name} | {cells} | {'' if by_scene is first else gain} | {seconds:.2f} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True)
    parser.add_argument("--ways", nargs="+", required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    arguments = parser.parse_args()
    for way in arguments.ways:
        scores: dict[str, dict[str, list[Score]]] = {name: {} for name in ESTIMATES}
        for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
            for true in tqdm(scene.pairs, desc=f"{way}, {scene.name}", smoothing=0.05):
                if (found := read(arguments.matches, way.split("+"), true)) is not None:
                    for name, make in ESTIMATES.items():
                        scores[name].setdefault(scene.name, []).append(score(make, found, true, scene))
        print("\n".join(table(way, scores)), "\n", flush=True)


if __name__ == "__main__":
    main()
