"""What pairs that no row names add to the scenes of sparse batches.

python -m benchmarks.unasked --train-dir DIR --matches DIR [--scenes reichstag_26] [--shares 0.12 0.3] [--seeds 5]
    [--pairs-per-image 0 3 5] [--recipe classical]

Of a scene's pairs with a covisibility of at least 0.1 a share is asked for, drawn by a seed. Their matches are
those of `--matches` (a file SCENE/IMAGE0-IMAGE1.npz for each pair, of all of the recipe's units); further ones are
found here by its first unit, as in a run. `own` is the mAA of the asked pairs' own F; `scene` where they get that
of their cameras, if there is one; `focals` where the others are also estimated anew at the focal lengths that the
scene knows, as in a run.
"""

import argparse
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import read_image
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import PoseError, mean_average_accuracy
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.scene.batch import Batch, BatchPair
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.known_focals import KnownFocals
from mkpc_kaggle.scene.read import described
from mkpc_kaggle.scene.solve import solve
from mkpc_kaggle.scene.unasked import unasked_pairs


class Matched:
    """The pairs of a scene as a reconstruction is given them, each found once."""

    def __init__(self, scene: TrainScene, folder: Path, recipe: str) -> None:
        self.folder = folder / scene.name
        self.pipeline = assemble(recipe).pipeline()
        self.paths = list(dict.fromkeys(path for true in scene.pairs for path in true.pair.images))
        self.images = {path: found for path in self.paths if (found := described(path, read_image))}
        self.asked = cache(self._asked)
        self.unasked = cache(self._unasked)

    def _asked(self, first: Path, second: Path) -> BatchPair:
        with np.load(self.folder / f"{first.stem}-{second.stem}.npz") as kept:
            matches = Matches(kept["points0"], kept["points1"], kept["scores"])
        found = (UnitResult(self.pipeline.recipe.units[0], matches),)
        pair = with_estimate(PairMatch(found, images=(to_image(first), to_image(second))), self.pipeline.recipe)
        return BatchPair(str(first), str(second), matches, pair.estimate.matrix if pair.estimate.ok else None)

    def _unasked(self, first: Path, second: Path) -> BatchPair:
        pair = PairMatch(images=(to_image(first), to_image(second)))
        (pair,) = self.pipeline.match([pair], self.pipeline.recipe.units[:1])
        return BatchPair(str(first), str(second), pair.matches)


def rows(scene: TrainScene, matched: Matched, share: float, seed: int, densities: list[float]) -> Iterator[str]:
    rng = np.random.default_rng(seed)
    places = np.sort(rng.choice(len(scene.pairs), round(share * len(scene.pairs)), replace=False))
    chosen = [scene.pairs[place] for place in places]
    asked = [matched.asked(*true.pair.images) for true in chosen]
    paths = list(dict.fromkeys(path for true in chosen for path in true.pair.images))
    ends = [(paths.index(true.pair.image0), paths.index(true.pair.image1)) for true in chosen]
    own = score(scene, chosen, [pair.own for pair in asked])
    for density in densities:
        added = [matched.unasked(paths[i], paths[j]) for i, j in unasked_pairs(len(paths), ends, density)]
        batch = Batch(tuple(matched.images[path] for path in paths), (*asked, *added))
        recipe, config = matched.pipeline.recipe, SceneConfig()
        known_focals = KnownFocals(recipe.magsac, recipe.focal, config.focal_sigma) if recipe.focal else None
        solution = solve(batch, config, known_focals)
        answers = list(zip(asked, solution.choices[: len(asked)], strict=True))
        with_scene = [choice.F if choice.from_scene else pair.own for pair, choice in answers]
        best = [pair.own if choice.F is None else choice.F for pair, choice in answers]
        others = sum(choice.F is not None and not choice.from_scene for _, choice in answers)
        placed = sum(one.placed for one in solution.scenes)
        yield (
            f"{scene.name:16}{share:6.2f}{seed:5}{len(asked):6}{density:10.1f}{len(added):7}"
            f"{own:8.4f}{score(scene, chosen, with_scene):8.4f}{score(scene, chosen, best):8.4f}{others:7}"
            f"{placed:6}/{len(paths)}"
        )


def score(scene: TrainScene, chosen: list[TruePair], matrices: list[Matrix3 | None]) -> float:
    answers = zip(chosen, matrices, strict=True)
    errors = [PoseError.failed() if F is None else error_of(F, true, scene) for true, F in answers]
    return mean_average_accuracy(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=["reichstag_26"])
    parser.add_argument("--shares", nargs="+", type=float, default=[0.12, 0.3])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--pairs-per-image", nargs="+", type=float, default=[0, 3, 5])
    parser.add_argument("--recipe", default="classical")
    arguments = parser.parse_args()
    print(f"{'scene':16}{'share':>6}{'seed':>5}{'pairs':>6}{'per image':>10}{'added':>7}{'own':>8}", end="")
    print(f"{'scene':>8}{'focals':>8}{'pairs':>7}{'images':>8}")
    for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
        matched = Matched(scene, arguments.matches, arguments.recipe)
        for share in arguments.shares:
            for seed in range(arguments.seeds):
                for row in rows(scene, matched, share, seed, arguments.pairs_per_image):
                    print(row, flush=True)


if __name__ == "__main__":
    main()
