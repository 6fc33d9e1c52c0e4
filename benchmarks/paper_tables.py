"""The paper's tables, row by row, next to their published figures, with one command.

LIST is a list of pairs in the format of SuperGlue's evaluation (docs/benchmarks.md). IMAGES is the root
directory of its names. TRAIN_DIR is any train side of the Image Matching Challenge 2022. The rows are in
`paper_tables.toml`. The rows of a table share a work directory, so that common units run once; the last column
counts the units that a row ran. After a kill, a rerun resumes. `--pairs N` takes a sample of each list or
scene, and `--matcher` replaces all matchers. Usage:

python -m benchmarks.paper_tables --out DIR --weights DIR [--yfcc LIST IMAGES] [--scannet LIST IMAGES]
    [--imc TRAIN_DIR] [--rows "1200,1600 + 1400" ...] [--pairs N] [--protocol superglue] [--matcher NAME]
"""

import argparse
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from statistics import mean

from mkpc_kaggle.data.competition import TrainScene, read_train_side
from mkpc_kaggle.data.pairs import read_pairs
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session, interruptible
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.evaluation.validate import PROTOCOLS, Validation, by_protocol, validate
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS
from mkpc_kaggle.geometry.robust import Method
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe

TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def recipe_of(table: str, row: str, method: str, given: argparse.Namespace) -> Recipe:
    """Return a row's recipe, with the protocol and the matcher of the command, if given."""
    whole = load_recipe("imc2022" if table == "imc" else table)
    if table == "imc":
        own = next((unit for unit in whole.units if unit.matcher == row), None)
        units = [replace(own, stage=1)] if own else [*whole.units]
    else:
        parts = enumerate(row.split(" + "), start=1)
        units = [
            sized(whole.units[0], stage, side)
            for stage, sides in parts
            for side in sides.split(",")
        ]
    known = {
        unit.name: unit
        for unit in (replace(each, matcher=given.matcher or each.matcher) for each in units)
    }
    recipe = replace(
        whole, units=tuple(known.values()), matchers={} if given.matcher else whole.matchers
    )
    if table != "imc" and given.protocol in PROTOCOLS:
        recipe = by_protocol(recipe, given.protocol)
    return replace(
        recipe, name=f"{row} {method}", magsac=replace(recipe.magsac, method=Method(method))
    )


def sized(unit: Unit, stage: int, side: str) -> Unit:
    """Return the unit with another long side, or stretched to a width x height."""
    width, _, height = side.partition("x")
    area = f"{height}x{width}" if height else ""
    return replace(
        unit, stage=stage, long_side=0 if area else int(side), area=area, stretch=bool(area)
    )


def table(name: str, given: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of the table in Markdown, each row after its run."""
    scenes, is_imc, differences = scenes_of(name, given), name == "imc", []
    ours = (
        ["mAA"]
        if is_imc
        else [*(f"AUC {limit:g}" for limit in AUC_THRESHOLDS), "precision", "matching score"]
    )
    heads = [
        *ours,
        *(f"published {head}" for head in (["public", "private"] if is_imc else ours[:3])),
        "units run",
    ]
    yield f"| {' | '.join([f'{name}: {sum(len(scene.pairs) for scene in scenes)} pairs', 'estimator', *heads])} |"
    yield "| --- " * (2 + len(heads)) + "|"
    for row, method, *published in TABLES[name]:
        if row in (given.rows or [row]):
            assembly = assemble(recipe_of(name, row, method, given), weights=given.weights)
            scores = run(name, assembly, scenes, given)
            assert scores.report is not None
            own = (
                [scores.maa()] * 2
                if is_imc
                else [100 * scores.auc(limit) for limit in AUC_THRESHOLDS]
            )
            differences.append([mine - other for mine, other in zip(own, published, strict=True)])
            cells = own[:1] if is_imc else [*own, *(100 * share for share in scores.matching)]
            cells = [f"{cell:.{4 if is_imc else 2}f}" for cell in cells]
            yield f"| {' | '.join([row, method, *cells, *map(str, [*published, scores.report.units_run])])} |"
    means = [f"{mean(column):+.4f}" for column in zip(*differences, strict=True)]
    yield f"| {' | '.join(['mean difference', *[''] * (len(heads) - len(means)), *means, ''])} |"


def scenes_of(name: str, given: argparse.Namespace) -> tuple[TrainScene, ...]:
    if name == "imc":
        return read_train_side(*given.imc, pairs_per_scene=given.pairs)
    return (read_pairs(*vars(given)[name], most=given.pairs),)


def run(
    name: str, assembly: Assembly, scenes: tuple[TrainScene, ...], given: argparse.Namespace
) -> Validation:
    root, in_front = str(vars(given)[name][-1]), given.protocol in PROTOCOLS
    with interruptible() as interrupt:
        session = Session(given.out / name, Budget(time.monotonic()), interrupt, workers=None)
        validation = validate(scenes, assembly, session, root, in_front=in_front)
    if interrupt.is_set():
        raise KeyboardInterrupt
    return validation


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--yfcc", type=Path, nargs=2, metavar=("LIST", "IMAGES"))
    parser.add_argument("--scannet", type=Path, nargs=2, metavar=("LIST", "IMAGES"))
    parser.add_argument("--imc", type=Path, nargs=1, metavar="TRAIN_DIR")
    rows = sorted({row for rows in TABLES.values() for row, *_ in rows})
    parser.add_argument("--rows", nargs="+", choices=rows, help="default: all")
    parser.add_argument(
        "--pairs", type=int, help="of each list or scene, evenly spread; default: all"
    )
    parser.add_argument(
        "--protocol", choices=[*PROTOCOLS, "none"], default="superglue", help="none: as the recipe"
    )
    parser.add_argument("--matcher")
    given = parser.parse_args(arguments)
    try:
        for line in chain.from_iterable(table(name, given) for name in TABLES if vars(given)[name]):
            print(line, flush=True)
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
