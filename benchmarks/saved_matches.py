"""Matches of a recipe on pairs with known cameras, kept on disk for the benchmark of what follows them.

python -m benchmarks.saved_matches --train-dir DIR --matches DIR [--weights DIR] [--recipes classical light]
    [--scenes NAME ...] [--every N]

All pairs with a covisibility of at least 0.1 are matched. Each gets a file MATCHES/RECIPE/SCENE/IMAGE0-IMAGE1.npz:
``points0``, ``points1`` (N, 2) and ``scores`` (N,) in image pixels, unit by unit; ``units``, each as JSON, and
``lengths``, the numbers of their matches; ``size0`` and ``size1``, width and height. Killed or stopped, the same
command goes on.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mkpc_kaggle.data.competition import TruePair, read_train_side
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.view_graph import tracks_of


@dataclass(frozen=True, eq=False)
class SavedMatches:
    """What each unit found on a pair, and the sizes of its images."""

    results: tuple[UnitResult, ...]
    sizes: tuple[Size, Size]

    @property
    def matches(self) -> Matches:
        """The matches of all units."""
        return Matches.concatenate(result.matches for result in self.results)

    @property
    def tracks(self) -> dict[str, Matches]:
        """The matches that a scene is made of, by their matchers."""
        return tracks_of(self.results)


def file_of(folder: Path, true: TruePair) -> Path:
    return folder / true.pair.group / f"{'-'.join(image.stem for image in true.pair.images)}.npz"


def write(path: Path, pair: PairMatch) -> None:
    """The file appears whole or not at all."""
    matches = pair.matches
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as stream:
        np.savez(
            stream,
            points0=matches.points0,
            points1=matches.points1,
            scores=matches.scores,
            units=[json.dumps(asdict(result.unit)) for result in pair.results],
            lengths=[len(result.matches) for result in pair.results],
            size0=pair.images[0].size,
            size1=pair.images[1].size,
        )
    part.replace(path)


def read(path: Path) -> SavedMatches:
    with np.load(path) as kept:
        matches = Matches(kept["points0"], kept["points1"], kept["scores"])
        ends = np.cumsum(kept["lengths"])
        results = tuple(
            UnitResult(Unit(**json.loads(str(unit))), matches[slice(end - length, end)])
            for unit, length, end in zip(kept["units"], kept["lengths"], ends, strict=True)
        )
        size0, size1 = (Size(*map(int, kept[name])) for name in ("size0", "size1"))
        return SavedMatches(results, (size0, size1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--recipes", nargs="+", default=["classical"])
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument("--every", type=int, default=1, help="of a scene's pairs; default: all of them")
    arguments = parser.parse_args()
    for name in arguments.recipes:
        pipeline = assemble(name, weights=arguments.weights).pipeline()
        for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
            for true in tqdm(scene.pairs[:: arguments.every], desc=f"{name}, {scene.name}", smoothing=0.05):
                path = file_of(arguments.matches / Path(name).stem, true)
                if not path.exists():
                    images = tuple(to_image(image) for image in true.pair.images)
                    (found,) = pipeline.match([PairMatch(images=images)], pipeline.recipe.units)
                    write(path, found)


if __name__ == "__main__":
    main()
