"""The command ``validate``."""

import argparse
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.competition import TrainScene, missing_line
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.session import Interrupt, Session, interruptible
from mkpc_kaggle.errors import UserError, temporary_directory
from mkpc_kaggle.evaluation.validate import (
    Validation,
    comparison_table,
    resolution_line,
    score_table,
    to_json,
    validate,
)
from mkpc_kaggle.recipe import split_mode
from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble
from mkpc_kaggle.setup.assembly import Assembly

HELP = """\
Run a recipe on a train side with the engine that makes submissions, and score it as the competition
does. A train side has calibration.csv, pair_covisibility.csv and images/ in each scene, and
scaling_factors.csv next to the scenes.

The score is the mAA over rotation errors of 1 to 10 degrees and translation errors of 0.2 to 5
metres, of each scene and as the mean of the scenes, with a column for each step of the estimate:
MAGSAC alone, with the prior on focal lengths, with the cameras of the scene. The next columns are
the AUC of the larger angular error up to 5, 10 and 20 degrees, after the last step.

With --compare, several recipes run on the same pairs and are compared with the first.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--train-dir", type=Path, required=True, metavar="DIR", help="train side, with poses")
    options.add_train_side(parser)
    options.add_matching(parser)
    text = "F from each pair's matches alone, even if the recipe reconstructs scenes"
    add("--no-scenes", dest="reconstruct", action="store_const", const=False, help=text)
    add(
        "--units",
        metavar="A,B",
        help="units to run, in this order, such as 1:sift@1536; default: the recipe's",
    )
    text = """run these instead of --recipe and --mode, and give the gain of each over the first with its 95 %%
        interval; such as classical:whole-images classical"""
    add("--compare", nargs="+", metavar="RECIPE[:MODE]", help=text)
    options.add_run(parser, time_limit=None)
    options.add_json(parser)
    text = """keep the journal there and resume from it; report.html (with --compare, a page for each recipe) shows
        the run; default: a temporary directory"""
    add("--work-dir", type=Path, metavar="DIR", help=text)


def run(arguments: argparse.Namespace) -> int:
    compared: list[str] = arguments.compare or []
    if compared and arguments.units:
        raise UserError("--units chooses from one recipe; --compare takes recipes as they are")
    if len(compared) == 1:
        raise UserError("--compare needs two recipes or more")
    # Before any work: a run of hours must not end in an output that cannot be written.
    require_apart({"--json": arguments.json}, [arguments.train_dir], arguments.work_dir)
    scenes = options.train_side_of(arguments)
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    if line := missing_line(pairs):
        logger.info(line)
    if line := resolution_line(scenes):
        logger.warning(line)
    with ExitStack() as closed:
        # Without a work directory, nothing is kept.
        work_dir = arguments.work_dir or closed.enter_context(temporary_directory())
        interrupt = closed.enter_context(interruptible())
        session = Session(work_dir, options.budget_of(arguments), interrupt)
        watched = closed.enter_context(session.watched())
        watched.save = lambda: "the time limit passed before the scores were printed"
        status, runs = _run_recipes(arguments, scenes, work_dir, interrupt)
    if compared and len(runs) == len(compared):
        logger.info("\n".join(["", *comparison_table(runs)]))
    options.write_json(arguments, list(map(to_json, runs)))
    return status


def _run_recipes(
    arguments: argparse.Namespace,
    scenes: Sequence[TrainScene],
    work_dir: Path,
    interrupt: Interrupt,
) -> tuple[int, list[Validation]]:
    """Run the recipes, which share a journal, so that common units run once. Return the worst exit
    status, and the complete runs: a comparison of unequal pairs would mean nothing.
    """
    compared: list[str] = arguments.compare or []
    choices = [split_mode(text) for text in compared] or [(arguments.recipe, arguments.mode)]
    # All of them first: a wrong name should not end a comparison after its first run.
    assemblies = [_assemble(arguments, interrupt, *choice) for choice in choices]
    runs: list[Validation] = []
    status = 0
    for number, assembly in enumerate(assemblies):
        budget = options.budget_of(arguments)
        session = Session(work_dir, budget, interrupt, workers=arguments.workers)
        validation = validate(scenes, assembly, session, str(arguments.train_dir))
        report = validation.report
        assert report is not None
        left_out = left_out_line(assembly.recipe, assembly.left_out)
        lines = [left_out, summary(report), f"recipe {validation.recipe}"]
        logger.info("\n".join(filter(None, [*lines, *score_table(validation)])))
        page = None
        if arguments.work_dir is not None:
            # A recipe may be a path, and a mode is joined by a colon.
            name = re.sub(r"[^\w.-]+", "_", compared[number] if compared else "report")
            page = work_dir / f"{name}.html"
        session.status = max(status, bool(trouble(report) or report.unsaved))
        pairs = [true.pair for scene in scenes for true in scene.pairs]
        status = options.finish(session, page, pairs)
        if compared and not report.ending.is_done:
            logger.info(
                "nothing is compared until all is done; with a --work-dir, the same command resumes"
            )
            return status or 1, runs
        runs.append(validation)
    return status, runs


def _assemble(
    arguments: argparse.Namespace, interrupt: Interrupt, name: str, mode: str
) -> Assembly:
    """Return the assembly of a recipe, as changed by the command's options."""
    assembly = options.assembly_of(arguments, name, mode, interrupt)
    if arguments.units is None:
        return assembly
    return replace(assembly, recipe=assembly.recipe.with_units(arguments.units.split(",")))
