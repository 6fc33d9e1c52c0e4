"""The paper's tables, row by row, next to their published figures, with one command.

LIST is a list of pairs in the format of SuperGlue's evaluation (docs/benchmarks.md). IMAGES is the
root directory of its names. TRAIN_DIR is any train side of the Image Matching Challenge 2022. The
rows are in `paper_tables.toml`. The rows of a table share a work directory, so that common units
run once; the last column counts the units that a row ran. After a kill, a rerun resumes. `--pairs
N` takes a sample of each list or scene, and `--matcher` replaces all matchers. Usage:

python -m benchmarks.paper_tables --out DIR --weights DIR [--yfcc LIST IMAGES] [--scannet LIST IMAGES]
    [--imc TRAIN_DIR] [--rows "1200,1600 + 1400" ...] [--pairs N] [--protocol superglue] [--matcher NAME]
"""

import argparse
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean

from mkpc_kaggle.data.competition import TrainScene, read_train_side
from mkpc_kaggle.data.pairs import read_pairs
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.session import Session, interruptible
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.evaluation.validate import PROTOCOLS, Validation, by_protocol, validate
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS
from mkpc_kaggle.geometry.robust import Method
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.setup.assembly import Assembly, assemble

TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def recipe_of(table: str, row: str, method: str, given: argparse.Namespace) -> Recipe:
    """Return a row's recipe, with the protocol and the matcher of the command, if given."""
    whole = load_recipe("imc2022" if table == "imc" else table)
    units: list[Unit] = []
    if table == "imc":
        # A row names one matcher of the ensemble, on whole images, or the whole ensemble.
        own = next((unit for unit in whole.units if unit.matcher == row), None)
        units += [replace(own, stage=1)] if own else whole.units
    else:
        # "1200,1600 + 1400": long sides of stage 1, then of stage 2.
        for stage, sides in enumerate(row.split(" + "), start=1):
            units += [sized(whole.units[0], stage, side) for side in sides.split(",")]
    # With one matcher for all, units may become equal; each runs once.
    known = {}
    for unit in units:
        changed = replace(unit, matcher=given.matcher or unit.matcher)
        known[changed.name] = changed
    options = {} if given.matcher else whole.matchers
    recipe = replace(whole, units=tuple(known.values()), matchers=options)
    if table != "imc" and given.protocol in PROTOCOLS:
        recipe = by_protocol(recipe, given.protocol)
    # The table's estimator replaces the protocol's, whose threshold stays.
    magsac = replace(recipe.magsac, method=Method(method))
    return replace(recipe, name=f"{row} {method}", magsac=magsac)


def sized(unit: Unit, stage: int, side: str) -> Unit:
    """Return the unit with another long side, or stretched to a width x height."""
    width, _, height = side.partition("x")
    area = f"{height}x{width}" if height else ""
    long_side = 0 if area else int(side)
    return replace(unit, stage=stage, long_side=long_side, area=area, stretch=bool(area))


def table(name: str, given: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of the table in Markdown, each row after its run."""
    scenes = scenes_of(name, given)
    is_imc = name == "imc"
    if is_imc:
        ours = ["mAA"]
        theirs = ["public", "private"]  # of the leaderboard; one score of ours is compared to both
    else:
        theirs = [f"AUC {limit:g}" for limit in AUC_THRESHOLDS]
        ours = [*theirs, "precision", "matching score"]
    heads = [*ours, *(f"published {head}" for head in theirs), "units run"]
    count = sum(len(scene.pairs) for scene in scenes)
    yield row_of([f"{name}: {count} pairs", "estimator", *heads])
    yield "| --- " * (2 + len(heads)) + "|"
    differences = []
    for row, method, *published in TABLES[name]:
        if row not in (given.rows or [row]):
            continue
        assembly = assemble(recipe_of(name, row, method, given), weights=given.weights)
        scores = run(name, assembly, scenes, given)
        assert scores.report is not None
        if is_imc:
            compared = [scores.maa()] * 2
            cells = [f"{scores.maa():.4f}"]
        else:
            # In percent, as published.
            compared = [100 * scores.auc(limit) for limit in AUC_THRESHOLDS]
            shares = [100 * share for share in scores.matching]
            cells = [f"{cell:.2f}" for cell in (*compared, *shares)]
        both = zip(compared, published, strict=True)
        differences.append([own - other for own, other in both])
        figures = [str(figure) for figure in published]
        yield row_of([row, method, *cells, *figures, str(scores.report.units_run)])
    means = [f"{mean(column):+.4f}" for column in zip(*differences, strict=True)]
    # Below the published figures.
    empty = [""] * (len(heads) - len(means))
    yield row_of(["mean difference", *empty, *means, ""])


def row_of(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def scenes_of(name: str, given: argparse.Namespace) -> tuple[TrainScene, ...]:
    """Return the pairs of a table, from a train side or a list."""
    if name == "imc":
        return read_train_side(*given.imc, pairs_per_scene=given.pairs)
    return (read_pairs(*vars(given)[name], most=given.pairs),)


def run(
    name: str, assembly: Assembly, scenes: tuple[TrainScene, ...], given: argparse.Namespace
) -> Validation:
    """Run a row's recipe. Raise ``KeyboardInterrupt`` if it was interrupted."""
    root = str(vars(given)[name][-1])
    in_front = given.protocol in PROTOCOLS
    with interruptible() as interrupt:
        session = Session(given.out / name, Budget(time.monotonic()), interrupt, workers=None)
        validation = validate(scenes, assembly, session, root, in_front=in_front)
    # The engine ends an interrupted run in order, with scores of a part of the pairs.
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
    # Line by line: a table takes hours, and its rows are worth reading before the last one.
    try:
        for name in TABLES:
            # A table without its data is left out.
            if vars(given)[name]:
                for line in table(name, given):
                    print(line, flush=True)
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
