"""ALIKED + LightGlue with trained weights on photographs of the demo set: the device and the CPU."""

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.gpu.record import EXPECTED, Part, SkippedError
from benchmarks.gpu.setup import Setup
from mkpc_kaggle.data.competition import read_test_side
from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.weights import WeightStore
from tests.support.pictures import agreement

NAME = "aliked_lightglue"
SLOTS = ("aliked-n16", "aliked-lightglue")
PAIRS = 8
QUICK_PAIRS = 2
LONG_SIDE = 1024
QUICK_SIDE = 320
SAME_PX = 0.25
SAME = {Precision.FLOAT32: 0.98, Precision.FLOAT16: 0.9, Precision.BFLOAT16: 0.8}


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each precision on the device: the share of the CPU's matches that it finds."""
    weights = WeightStore(setup.weights)
    missing = [slot for slot in SLOTS if weights.file_of(slot) is None]
    if missing:
        where = "--weights DIR or MKPC_WEIGHTS names their folder"
        raise SkippedError(f"no trained weights of {', '.join(missing)}; {where}")
    unit = Unit(1, NAME, QUICK_SIDE if setup.quick else LONG_SIDE)
    count = QUICK_PAIRS if setup.quick else PAIRS
    pairs = [
        _images(*pair.images) for pair in islice(read_test_side(setup.demo().test_dir), count)
    ]
    on_cpu = _points(weights, unit, pairs, Placement())
    for precision in Precision:
        part.check_time()
        with part.row(precision=str(precision)) as row:
            found = _points(weights, unit, pairs, Placement(setup.device, precision))
            shares = [
                agreement(*both, SAME_PX, torch.inf)
                for both in zip(found, on_cpu, strict=True)
            ]
            row["pairs"] = len(pairs)
            row["matches"] = sum(map(len, found))
            row["matches of the CPU"] = sum(map(len, on_cpu))
            row[f"in common, {SAME_PX} px"] = sum(shares) / len(shares)
            is_same = sum(shares) / len(shares) >= SAME[precision]
            row["verdict"] = EXPECTED if is_same else f"less than {SAME[precision]} in common"


def _images(first: Path, second: Path) -> tuple[Image, Image]:
    images = []
    for path in (first, second):
        image = read_image(path)
        if not isinstance(image, Image):
            raise OSError(str(image))
        images.append(image)
    return images[0], images[1]


def _points(
    weights: WeightStore, unit: Unit, pairs: list[tuple[Image, Image]], placement: Placement
) -> list[Any]:
    """Return the points (M, 4) of each pair, in pixels of both images."""
    options = spec_of(NAME, "benchmark").options()
    matcher = load_matcher(NAME, weights, options, placement)
    pipeline = Pipeline(Recipe((unit,)), lambda _: matcher)
    found = pipeline.match([PairMatch(images=images) for images in pairs], [unit])
    points = []
    for pair in found:
        (result,) = pair.results
        if result.failure:
            raise RuntimeError(result.failure)
        both = np.hstack([result.matches.points0, result.matches.points1])
        points.append(torch.from_numpy(both))
    return points
