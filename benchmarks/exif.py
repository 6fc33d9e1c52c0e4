"""What focal lengths from EXIF gain: F with none, with those within 3 % of the truth, and with the true ones.

python -m benchmarks.exif --train-dir DIR --journal DIR [--recipe classical] [--scenes NAME ...]

The matches are those of a journal, a work directory of `validate`; pairs that it lacks are left out. The recipe
says what is made of them. An image's error is drawn once, evenly within the bounds. A table for pairs and one
for scenes, as of `benchmarks.estimation`.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
from tqdm import tqdm

from benchmarks.estimation import SCENE, Score, accuracy, batch_pair, read_journal, table
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.geometry.focal_prior import FocalPrior, estimate_with_prior
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Recipe, load_recipe
from mkpc_kaggle.scene.reconstruct import reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchPair

ERRORS = {"no EXIF": None, "EXIF within 3 %": 0.03, "EXIF true": 0.0}


def exif_focals(true: TruePair, error: float | None) -> tuple[float, float]:
    """The focal lengths in pixels that EXIF would tell of both images, 0 for none."""
    if error is None:
        return 0.0, 0.0
    cameras = zip(true.pair.images, (true.camera0, true.camera1), strict=True)
    drawn = [(np.random.default_rng(crc32(path.stem.encode())).uniform(-error, error), c) for path, c in cameras]
    first, second = (float(camera.K[0, 0] * (1 + factor)) for factor, camera in drawn)
    return first, second


def score(
    pairs: Sequence[tuple[TruePair, PairMatch]], scene: TrainScene, recipe: Recipe, error: float | None
) -> tuple[Score, Score]:
    """Of the pairs alone, and with the cameras of the scene."""
    assert recipe.focal is not None
    assert recipe.scene is not None
    start, batch = time.process_time(), list[BatchPair]()
    for true, found in tqdm(pairs, desc=f"{scene.name}, {error}", smoothing=0.05):
        focals = exif_focals(true, error)
        known = zip(found.sizes, focals, strict=True)
        first, second = (FocalPrior.of_image(size, recipe.focal, focal) for size, focal in known)
        result = estimate_with_prior(found.matches, (first, second), recipe.magsac, recipe.focal)
        pair = batch_pair(true, found, result.matrix if result.ok else None)
        ends = replace(pair.image0, focal=focals[0]), replace(pair.image1, focal=focals[1])
        batch.append(replace(pair, image0=ends[0], image1=ends[1]))
    between = time.process_time()
    choices = reconstruct_batch(batch, recipe.scene, recipe.focal, recipe.magsac).choices
    end = time.process_time()
    alone = [pair.pair_fundamental for pair in batch]
    together = [own if choice.F is None else choice.F for own, choice in zip(alone, choices, strict=True)]
    by_pairs, by_scene = (
        tuple(accuracy(F, true, scene) for F, (true, _) in zip(matrices, pairs, strict=True))
        for matrices in (alone, together)
    )
    return Score(by_pairs, between - start), Score(by_scene, end - between)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--journal", type=Path, required=True)
    parser.add_argument("--recipe", default="classical")
    parser.add_argument("--scenes", nargs="*", default=())
    arguments = parser.parse_args()
    recipe, (_, known) = load_recipe(arguments.recipe), read_journal(arguments.journal)
    alone: dict[str, list[dict[str, Score]]] = {}
    together: dict[str, list[dict[str, Score]]] = {}
    for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
        if pairs := [(true, known[true.pair.id]) for true in scene.pairs if true.pair.id in known]:
            scores = {name: score(pairs, scene, recipe, error) for name, error in ERRORS.items()}
            alone[scene.name] = [{name: of_pairs for name, (of_pairs, _) in scores.items()}]
            together[scene.name] = [{f"{SCENE}, {name}": of_scene for name, (_, of_scene) in scores.items()}]
    print("\n".join(table(f"{recipe.name}, pairs", alone, list(ERRORS))), "\n")
    print("\n".join(table(f"{recipe.name}, scenes", together, [f"{SCENE}, {name}" for name in ERRORS])))


if __name__ == "__main__":
    main()
