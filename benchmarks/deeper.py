"""Scale beyond what stage 1 sees: a second crop, and tiles for pairs without support.

python -m benchmarks.deeper --train-dir DIR --journal DIR --facts FILE [--chosen REGEX]

The journal, the work directory of ``benchmarks.crops`` whose last layout has crops, provides the matches of
both stages. For each pair:

* *again*: MKPC on the points of both stages, and one more inference on these crops; at equal inference count
  the crops of stage 1's points, once more in the same size;
* *tiles*, if F of stage 1 has less support than an overlap needs: each image whole, at SIDE pixels, against
  the other's nine overlapping tiles of half its sides, which shows them at twice the scale; then one more
  inference on the crops of all these points.

Pairs become lines of ``--facts``; a further run matches only the pairs that are missing there. Gains are in mAA,
F of single pairs with the prior of `light`, intervals by images. ``--chosen`` names the scenes for choosing.
"""

import argparse
import json
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.estimation import LIGHT, read_journal, with_prior
from mkpc_kaggle import critical_region
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.evaluation.compare import Paired, paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import MkpcConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT, support
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.setup.arguments import to_image
from mkpc_kaggle.setup.assembly import assemble

SIDE, TILE_SIDE = 1024, 768  # pixels of the views of crops and of tiles
TILES = [(x / 4, y / 4) for y in range(3) for x in range(3)]  # left and top, of the image
BOTH = "both stages"
ROWS = (
    ("again", "crops of stage 1 again", "crops of both stages' points"),
    ("tiles", BOTH, "tiles"),
    ("tiles and their crops", BOTH, "tiles and their crops"),
)


UNITS = {
    SIDE: Unit(2, "aliked_lightglue", SIDE),
    TILE_SIDE: Unit(2, "aliked_lightglue", TILE_SIDE),
}


def boxes_of(matches: Matches, sizes: Sequence[Size]) -> tuple[Box, Box]:
    """Return the boxes of MKPC."""
    first = critical_region(matches.points0, sizes[0], MkpcConfig()).box
    second = critical_region(matches.points1, sizes[1], MkpcConfig()).box
    return first, second


def tiles_of(size: Size) -> list[Box]:
    width, height = size
    boxes = []
    for x, y in TILES:
        left, top = round(x * width), round(y * height)
        boxes.append(Box(left, top, left + width // 2, top + height // 2))
    return boxes


def accuracy(
    results: Sequence[UnitResult], found: PairMatch, true: TruePair, scene: TrainScene
) -> float:
    """Return the accuracy of F from the matches of these results."""
    estimate = with_prior(replace(found, results=tuple(results)), focal=LIGHT)
    return pair_accuracy(
        error_of(estimate.matrix, true, scene) if estimate.ok else PoseError.failed()
    )


class Experiment:
    """The inferences beyond the two stages, by ALIKED + LightGlue on a CPU."""

    def __init__(self) -> None:
        self.pipeline = Pipeline.of(assemble("aliked_lightglue", device="cpu"))

    def matched(self, true: TruePair, boxes: tuple[Box, Box], side: int) -> UnitResult:
        """Return the result of one inference on these boxes."""
        images = (to_image(true.pair.file0), to_image(true.pair.file1))
        self.pipeline.regions = {(images[0].name, images[1].name): boxes}
        (pair,) = self.pipeline.match([PairMatch(images=images)], [UNITS[side]])
        (result,) = pair.results
        if result.failure:
            raise ValueError(f"{true.pair.id}: {result.failure}")
        return result

    def facts(self, true: TruePair, found: PairMatch, scene: TrainScene) -> dict[str, Any]:
        """Return the accuracy of each row of a pair, and its CPU seconds of tiles."""
        sizes = found.sizes
        of_stage = [
            [each for each in found.results if each.unit.stage == stage] for stage in (1, 2)
        ]
        first = Matches.concatenate(each.matches for each in of_stage[0])

        def crop(matches: Matches) -> list[UnitResult]:
            return [self.matched(true, boxes_of(matches, sizes), SIDE)]

        base = list(found.results)
        once_more = crop(first)
        again = crop(found.matches)
        results = {
            BOTH: base,
            "stage 1": of_stage[0],
            "crops of stage 1 again": base + once_more,
            "crops of both stages' points": base + again,
        }
        estimate = with_prior(replace(found, results=tuple(of_stage[0])), focal=LIGHT)
        seen = support(estimate.matrix, first) if estimate.ok else 0.0
        start = time.process_time()
        if seen < MIN_SUPPORT:
            tiled: list[UnitResult] = []
            for tile in tiles_of(sizes[1]):
                tiled.append(self.matched(true, (Box.whole(sizes[0]), tile), TILE_SIDE))
            for tile in tiles_of(sizes[0]):
                tiled.append(self.matched(true, (tile, Box.whole(sizes[1])), TILE_SIDE))
            every = Matches.concatenate(each.matches for each in [*of_stage[0], *tiled])
            results["tiles"] = base + tiled
            results["tiles and their crops"] = base + tiled + crop(every)
        values = {name: accuracy(each, found, true, scene) for name, each in results.items()}
        seconds = time.process_time() - start
        names = list(true.pair.names)
        return {"scene": scene.name, "pair": names, "support": seen, "seconds": seconds, **values}


def gains(facts: Sequence[dict[str, Any]], before: str, after: str) -> str:
    """Return means and gain, over scenes; a row that was not tried changes nothing."""
    compared: list[Paired] = []
    for scene in sorted({each["scene"] for each in facts}):
        pairs = [each for each in facts if each["scene"] == scene]
        first = [each[before] for each in pairs]
        second = [each.get(after, each[before]) for each in pairs]
        compared.append((first, second, [tuple(each["pair"]) for each in pairs]))
    means = [
        fmean(fmean(values) for values in side) for side in list(zip(*compared, strict=True))[:2]
    ]
    return f"{means[0]:.3f} | {means[1]:.3f} | {paired_difference(compared)}"


def table(facts: Sequence[dict[str, Any]], chosen: str) -> Iterator[str]:
    yield "| pairs of | number | tried | what | before | after | gain |"
    yield "|" + " --- |" * 7
    groups = {"all": facts}
    for scale in sorted({each["scene"].rpartition("_zoom")[2] for each in facts}):
        groups[f"x{scale}"] = [each for each in facts if each["scene"].endswith(f"_zoom{scale}")]
    if chosen:
        groups["chosen on"] = [each for each in facts if re.match(chosen, each["scene"])]
        groups["confirmed on"] = [each for each in facts if not re.match(chosen, each["scene"])]
    groups["without support"] = [each for each in facts if each["support"] < MIN_SUPPORT]
    for title, group in groups.items():
        for name, before, after in ROWS:
            if group:
                tried = sum(after in each for each in group)
                yield f"| {title} | {len(group)} | {tried} | {name} | {gains(group, before, after)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--journal", type=Path, required=True)
    parser.add_argument("--facts", type=Path, required=True)
    parser.add_argument("--chosen", default="", metavar="REGEX")
    arguments = parser.parse_args()
    arguments.facts.touch()
    done = [json.loads(line) for line in arguments.facts.read_text(encoding="utf-8").splitlines()]
    names = {(each["scene"], *each["pair"]) for each in done}
    _, journal = read_journal(arguments.journal)
    experiment = Experiment()
    with arguments.facts.open("a", encoding="utf-8") as stream:
        for scene in read_train_side(arguments.train_dir):
            for true in scene.pairs:
                if true.pair.id in journal and (scene.name, *true.pair.names) not in names:
                    found, _ = journal[true.pair.id]
                    done.append(experiment.facts(true, found, scene))
                    stream.write(json.dumps(done[-1]) + "\n")
                    stream.flush()
    print("\n".join(table(done, arguments.chosen)), flush=True)


if __name__ == "__main__":
    main()
