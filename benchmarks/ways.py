"""Matches of small matchers, each with and without the crop, saved for the benchmarks of what follows them.

python -m benchmarks.ways --train-dir DIR --matches DIR [--weights DIR] [--ways sift light ...] [--scenes NAME ...]

A way is a recipe's units, or the same units all on whole images; `sift` needs no weights. A unit that several
ways share runs once for a pair. All pairs with a covisibility of at least 0.1 are matched, into MATCHES/WAY. Pairs
whose files are all there are left out: killed or stopped, the same command goes on.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from benchmarks import saved_matches
from mkpc_kaggle.data.competition import TruePair, read_train_side
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.pipeline.two_stage import to_image
from mkpc_kaggle.recipe import Recipe, Unit

XFEAT = (
    Unit(1, "xfeat_lighterglue", 1024, tracks=False),
    Unit(2, "xfeat_lighterglue", 1280, tracks=False),
)
ALIKED = (Unit(1, "aliked", 1024), Unit(2, "aliked", 800))
SIFT = (
    Unit(1, "sift", 1536, max_matches=8000),
    Unit(1, "sift", 1280, max_matches=8000),
    Unit(2, "sift", 1440, max_matches=8000),
)
LIGHT = (XFEAT[0], SIFT[1], SIFT[2], *ALIKED)
TWO_STAGE = {"sift": SIFT, "xfeat": XFEAT, "aliked": ALIKED, "light": LIGHT}
WAYS = {
    **TWO_STAGE,
    **{f"{name}_whole": tuple(replace(unit, stage=1) for unit in units) for name, units in TWO_STAGE.items()},
}


def recipe_of(ways: Sequence[str]) -> Recipe:
    """All units of these ways, each once."""
    units = sorted({unit: None for way in ways for unit in WAYS[way]}, key=lambda unit: unit.stage)
    return Recipe(tuple(units), "ways", matchers={"sift": {"features": 8000, "ratio": 0.8}})


def match_all(pair: PairMatch, ways: Sequence[str], pipeline: Pipeline) -> dict[str, PairMatch]:
    """Every way on one pair: units of stage 1 once, those of stage 2 on the critical regions of their own way."""
    (whole,) = pipeline.match([pair], [unit for unit in pipeline.recipe.units if unit.stage == 1])
    known = {result.unit: result for result in whole.results}
    done = {}
    for name in ways:
        units = WAYS[name]
        stage1 = tuple(known[unit] for unit in units if unit.stage == 1)
        stage2 = [unit for unit in units if unit.stage == 2]
        (found,) = pipeline.match([replace(pair, results=stage1)], stage2)
        by_unit = {result.unit: result for result in found.results}
        done[name] = replace(found, results=tuple(by_unit[unit] for unit in units))
    return done


def readable(true: TruePair, images: dict[Path, Image]) -> tuple[Image, Image]:
    """The two images, read once each."""
    for path in true.pair.images:
        if path not in images:
            images[path] = to_image(path)
    return images[true.pair.image0], images[true.pair.image1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--matches", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--scenes", nargs="*", default=())
    arguments = parser.parse_args()
    pipeline = assemble(recipe_of(arguments.ways), weights=arguments.weights).pipeline()
    for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
        images: dict[Path, Image] = {}
        for true in tqdm(scene.pairs, desc=scene.name, smoothing=0.05):
            files = {way: saved_matches.file_of(arguments.matches / way, true) for way in arguments.ways}
            if all(file.exists() for file in files.values()):
                continue
            pair = PairMatch(images=readable(true, images))
            for way, found in match_all(pair, arguments.ways, pipeline).items():
                saved_matches.write(files[way], found)


if __name__ == "__main__":
    main()
