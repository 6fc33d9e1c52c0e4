"""Seconds a pair with and without cached encodings, LoFTR at 640 x 480, every image in eight pairs.

python -m benchmarks.encoding_cache
"""

import time
from itertools import combinations

import numpy as np

from benchmarks.matchers import VGA, photographs
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.loftr import SPEC
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import ENCODING_CACHE_BYTES, Pipeline
from mkpc_kaggle.recipe import Recipe, Unit
from tests.support.standin import filled

IMAGES = 9


def main() -> None:
    picture = photographs(VGA)[0]
    images = [Image.of_array(np.roll(picture, 8 * number, axis=1)) for number in range(IMAGES)]
    matcher = SemiDenseMatcher(placed(filled(Loftr(), "loftr"), Placement()), SPEC, "cpu")
    recipe = Recipe(units=(Unit(1, "loftr", VGA.width),))
    seconds = {}
    for name, cache_bytes in (("warm-up", 0), ("not cached", 0), ("cached", ENCODING_CACHE_BYTES)):
        works = [PairMatch(images=pair) for pair in combinations(images, 2)][: 1 if name == "warm-up" else None]
        pipeline = Pipeline(recipe, lambda _: matcher, cache_bytes=cache_bytes)
        start = time.perf_counter()
        pipeline.match(works, recipe.units)
        seconds[name] = (time.perf_counter() - start) / len(works)
    print(f"{len(works)} pairs of {IMAGES} images, seconds a pair:")
    for name in ("not cached", "cached"):
        print(f"  {name}: {seconds[name]:.3f}")
    print(f"  {seconds['not cached'] / seconds['cached']:.2f} times as fast")


if __name__ == "__main__":
    main()
