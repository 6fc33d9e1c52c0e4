"""The paper's tables of YFCC100M and ScanNet, row by row, with one command.

python -m benchmarks.paper_tables --out DIR --weights DIR [--yfcc LIST IMAGES] [--scannet LIST IMAGES]
    [--rows "one + two" ...] [--pairs N] [--method ransac] [--threshold 1] [--matcher superglue]

LIST is a list of pairs in the format of SuperGlue's evaluation, IMAGES the directory that its names start from
(docs/benchmarks.md). Each row is journalled in a directory of its own under DIR: killed or stopped, the same
command goes on there, and the tables with the AUC of each row are printed at the end. `--pairs N` takes a sample
of each list, `--matcher` another matcher in SuperGlue's place.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.data.competition import TrainScene
from mkpc_kaggle.data.pairs import read_pairs
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session, interruptible
from mkpc_kaggle.evaluation.validate import Validation, validate
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS
from mkpc_kaggle.geometry.robust import Method
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.recipe import Recipe, load_recipe


@dataclass(frozen=True)
class Row:
    """A row of a table: long sides on whole images and on critical regions; ``recipe`` has its settings."""

    name: str
    stage1: tuple[int, ...]
    stage2: tuple[int, ...] = ()
    recipe: str = ""

    def of(self, dataset: str, matcher: str) -> Recipe:
        """The recipe of this row, with another matcher in SuperGlue's place if that is wanted."""
        whole = load_recipe(self.recipe or dataset)
        wanted = {*((1, side) for side in self.stage1), *((2, side) for side in self.stage2)}
        chosen = [unit for unit in whole.units if (unit.stage, unit.long_side) in wanted]
        assert len(chosen) == len(wanted), f"{self} asks for sizes that {whole.name} lacks"
        units = tuple(replace(unit, matcher=matcher) for unit in sorted(chosen, key=lambda unit: unit.stage))
        return replace(whole, units=units, matchers=whole.matchers if matcher == "superglue" else {})


TABLES = {
    "yfcc": (
        Row("one", (1600,)),
        Row("two", (1200, 1600)),
        Row("three", (840, 1200, 1600)),
        Row("all sizes", (840, 1200, 1400, 1600), recipe="yfcc_naive"),
        Row("one + two", (1600,), (1200, 1400)),
        Row("two + one", (1200, 1600), (1400,)),
        Row("three + three", (840, 1200, 1600), (1200, 1400, 1600)),
    ),
    "scannet": (
        Row("one", (1280,)),
        Row("two", (1024, 1280)),
        Row("three", (840, 1024, 1280)),
        Row("all sizes", (640, 840, 1024, 1280, 1536), recipe="scannet_naive"),
        Row("one + two", (1280,), (840, 1280)),
        Row("two + one", (1024, 1280), (1280,)),
        Row("three + two", (840, 1024, 1280), (840, 1280)),
    ),
}
"""The sizes of the last row and of "all sizes" are the paper's; the others are a choice among the last's."""


def table(dataset: str, scene: TrainScene, arguments: argparse.Namespace) -> Iterator[str]:
    """The table in Markdown."""
    heads = " | ".join(f"AUC {threshold:g}" for threshold in AUC_THRESHOLDS)
    yield f"| {dataset}: {len(scene.pairs)} pairs | whole images | critical regions | {heads} |"
    yield "| --- " * (3 + len(AUC_THRESHOLDS)) + "|"
    for row in TABLES[dataset]:
        if row.name in (arguments.rows or [row.name]):
            validation = run(row, dataset, scene, arguments)
            sizes = [", ".join(map(str, sides)) or "-" for sides in (row.stage1, row.stage2)]
            areas = [f"{100 * validation.auc(threshold):.2f}" for threshold in AUC_THRESHOLDS]
            yield "| " + " | ".join([row.name, *sizes, *areas]) + " |"


def run(row: Row, dataset: str, scene: TrainScene, arguments: argparse.Namespace) -> Validation:
    recipe = row.of(dataset, arguments.matcher)
    magsac = replace(recipe.magsac, method=arguments.method, threshold=arguments.threshold)
    assembly = assemble(replace(recipe, magsac=magsac), weights=arguments.weights)
    work_dir = arguments.out / dataset / row.name.replace(" ", "")
    with interruptible() as interrupt:
        session = Session(work_dir, Budget(time.monotonic()), interrupt, workers=None)
        validation = validate([scene], assembly, session)
    if interrupt.is_set():
        raise KeyboardInterrupt
    return validation


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    for dataset in TABLES:
        parser.add_argument(f"--{dataset}", type=Path, nargs=2, metavar=("LIST", "IMAGES"))
    parser.add_argument(
        "--rows", nargs="+", choices=sorted({row.name for rows in TABLES.values() for row in rows})
    )
    parser.add_argument("--pairs", type=int, help="of each list, evenly spread; default: all")
    parser.add_argument("--method", type=Method, choices=list(Method), default=Method.RANSAC)
    parser.add_argument("--threshold", type=float, default=1.0, help="pixels, divided by the mean focal length")
    parser.add_argument("--matcher", default="superglue")
    given = parser.parse_args(arguments)
    for dataset in TABLES:
        if (paths := vars(given)[dataset]) is not None:
            scene = read_pairs(*paths, most=given.pairs)
            print("\n".join([*table(dataset, scene, given), ""]))


if __name__ == "__main__":
    main()
