"""The command ``validate``."""

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.competition import TrainScene, missing_line
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.session import Session
from mkpc_kaggle.errors import UserError, temporary_directory
from mkpc_kaggle.evaluation.validate import (
    Validation,
    comparison_table,
    score_table,
    to_json,
    validate,
)
from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble
from mkpc_kaggle.setup.assembly import Assembly
from mkpc_kaggle.setup.console import logger
from mkpc_kaggle.signals import interruptible

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
    text = """run these instead of --recipe, and give the gain of each over the first with its 95 %%
        interval; such as classical:whole-images classical"""
    add("--compare", nargs="+", metavar="RECIPE[:MODE]", help=text)
    options.add_run(parser, time_limit=None)
    options.add_json(parser)
    text = """keep the journal there and resume from it; report.html shows the run (with --compare, the last
        recipe's); default: a temporary directory"""
    add("--work-dir", type=Path, metavar="DIR", help=text)


def run(arguments: argparse.Namespace) -> int:
    recipes: list[str] = arguments.compare or [arguments.recipe]
    if arguments.compare and len(recipes) < 2:
        raise UserError("--compare needs two recipes or more")
    # Before any work: a run of hours must not end in an output that cannot be written.
    inputs = [arguments.train_dir, *options.recipe_files(*recipes)]
    require_apart({"--json": arguments.json}, inputs, arguments.work_dir, arguments.weights)
    scenes = options.train_side_of(arguments)
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    if line := missing_line(pairs):
        logger.info(line)
    runs: list[Validation] = []
    status = 0
    with ExitStack() as closed:
        # Without a work directory, nothing is kept.
        work_dir = arguments.work_dir or closed.enter_context(temporary_directory())
        interrupt = closed.enter_context(interruptible())
        budget = options.budget_of(arguments)
        session = Session(work_dir, budget, interrupt, workers=arguments.workers)
        closed.enter_context(session.watched())
        session.save = lambda: "the time limit passed before the scores were printed"
        # All of them first: a wrong name should not end a comparison after its first run.
        assemblies = [options.assembly_of(arguments, interrupt, text) for text in recipes]
        # They share a journal, so that common units run once.
        for assembly in assemblies:
            session.status = 1  # until the scores are printed
            validation = _run_recipe(arguments, scenes, assembly, session)
            runs.append(validation)
            page = None if arguments.work_dir is None else work_dir / "report.html"
            session.status = max(status, session.status)
            status = options.finish(session, page, pairs)
            # A comparison of unequal pairs would mean nothing.
            if arguments.compare and not (
                validation.report and validation.report.ending.is_done
            ):
                logger.info(
                    "nothing is compared until all is done; with a --work-dir, the same command resumes"
                )
                return status or 1
    if arguments.compare:
        logger.info("\n".join(["", *comparison_table(runs)]))
    options.write_json(arguments, list(map(to_json, runs)))
    return status


def _run_recipe(
    arguments: argparse.Namespace,
    scenes: Sequence[TrainScene],
    assembly: Assembly,
    session: Session,
) -> Validation:
    """Run one recipe, print its summary and its scores, and set the session's exit status."""
    validation = validate(scenes, assembly, session, str(arguments.train_dir))
    report = validation.report
    assert report is not None
    lines = [
        left_out_line(assembly.recipe, assembly.left_out),
        summary(report),
        f"recipe {validation.recipe}",
        *score_table(validation),
    ]
    logger.info("\n".join(filter(None, lines)))
    session.status = int(bool(trouble(report) or report.about.unsaved))
    return validation
