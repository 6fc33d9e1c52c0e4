"""The score of scenes under different settings, on the same matches.

python -m benchmarks.scene_settings --train-dir DIR --matches DIR [--scenes NAME ...] [--shares 1 0.3 0.12]
    [--settings default incremental ...] [--seed 0]

The matches of all pairs with a covisibility of at least 0.1 are those of one way of `benchmarks.ways`: DIR is its
directory. A share below 1 takes that many of a scene's pairs by the seed. `own` is the mAA of one MAGSAC a
pair, `scene` that of the cameras alone, where a pair without two of them counts as failed, `chosen` that of the F
which the pair gets in the end.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import saved_matches
from benchmarks.saved_matches import SavedMatches
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.geometry.metrics import PoseError, mean_average_accuracy, pose_error
from mkpc_kaggle.geometry.robust import Matrix3, RobustConfig, estimate
from mkpc_kaggle.scene.batch import Batch, BatchImage, BatchPair
from mkpc_kaggle.scene.config import CameraModel, Mapper, SceneConfig
from mkpc_kaggle.scene.solve import solve

DEFAULT = SceneConfig()
SETTINGS = {
    "default": DEFAULT,
    "incremental": replace(DEFAULT, mapper=Mapper.INCREMENTAL),
    "radial": replace(DEFAULT, camera_model=CameraModel.RADIAL),
    "cell 0.4": replace(DEFAULT, cell=0.4),
    "cell 1.5": replace(DEFAULT, cell=1.5),
    "verify 0.5": replace(DEFAULT, verification_error=0.5),
    "verify 2": replace(DEFAULT, verification_error=2.0),
    "verify 4": replace(DEFAULT, verification_error=4.0),
    "seed 1": replace(DEFAULT, seed=1),
    "together": replace(DEFAULT, each_matcher=False),
    "own cameras": replace(DEFAULT, one_camera=0.0),
}
ONE_MAGSAC = RobustConfig(permutations=1)


def matched(true: TruePair, found: SavedMatches) -> BatchPair:
    """A pair with its matches, and the F of one MAGSAC."""
    own = estimate(found.matches, ONE_MAGSAC)
    return BatchPair(*names_of(true), found.matches, own.matrix if own.ok else None, found.tracks)


def names_of(true: TruePair) -> tuple[str, str]:
    return true.pair.image0.stem, true.pair.image1.stem


def score(scene: TrainScene, chosen: list[TruePair], matrices: list[Matrix3 | None]) -> float:
    errors = [
        PoseError.failed() if F is None else pose_error(F, true.camera0, true.camera1, scene.metres_per_unit)
        for true, F in zip(chosen, matrices, strict=True)
    ]
    return mean_average_accuracy(errors)


def row(
    name: str,
    scene: TrainScene,
    share: float,
    seed: int,
    pairs: dict[str, BatchPair],
    images: dict[str, BatchImage],
) -> str:
    rng = np.random.default_rng(seed)
    places = np.sort(rng.choice(len(scene.pairs), round(share * len(scene.pairs)), replace=False))
    chosen = [scene.pairs[place] for place in places]
    asked = [pairs[true.pair.id] for true in chosen]
    used = {end for pair in asked for end in (pair.image0, pair.image1)}
    batch = Batch(tuple(images[end] for end in sorted(used)), tuple(asked))
    begin = time.process_time()
    solution = solve(batch, SETTINGS[name])
    seconds = time.process_time() - begin
    own = score(scene, chosen, [pair.own for pair in asked])
    cameras = score(scene, chosen, [choice.F for choice in solution.choices])
    best = [
        pair.own if choice.F is None else choice.F for pair, choice in zip(asked, solution.choices, strict=True)
    ]
    placed = sum(one.placed for one in solution.scenes)
    return (
        f"{scene.name:16}{len(asked):6}  {name:14}{own:8.4f}{cameras:8.4f}{score(scene, chosen, best):8.4f}"
        f"{placed:5}/{len(used):<4}{seconds:8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument("--shares", nargs="+", type=float, default=[1.0])
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(
        f"{'scene':16}{'pairs':>6}  {'settings':14}{'own':>8}{'scene':>8}{'chosen':>8}{'placed':>10}{'cpu s':>8}"
    )
    for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
        found = [saved_matches.read(saved_matches.file_of(arguments.matches, true)) for true in scene.pairs]
        known = list(zip(scene.pairs, found, strict=True))
        pairs = {true.pair.id: matched(true, one) for true, one in known}
        sizes = {name: size for true, one in known for name, size in zip(names_of(true), one.sizes, strict=True)}
        images = {name: BatchImage(name, name, size) for name, size in sizes.items()}
        for share in arguments.shares:
            for name in arguments.settings:
                print(row(name, scene, share, arguments.seed, pairs, images), flush=True)


if __name__ == "__main__":
    main()
