"""The command ``validate``."""

import argparse
import json
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.competition import TrainScene, missing_line
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.data.pairs import read_pairs
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.request import RunReport
from mkpc_kaggle.engine.session import Interrupt, Session, interruptible
from mkpc_kaggle.errors import UserError, temporary_directory, writing
from mkpc_kaggle.evaluation.compare import comparison_json, comparison_table, step_gains
from mkpc_kaggle.evaluation.validate import (
    PROTOCOLS,
    Validation,
    by_protocol,
    resolution_line,
    score_table,
    to_json,
    validate,
)
from mkpc_kaggle.recipe import split_mode, with_settings
from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble
from mkpc_kaggle.setup.assembly import Assembly

HELP = """\
Run a recipe on a train side with the engine that makes submissions, and score it as the competition does. A
train side has calibration.csv, pair_covisibility.csv and images/ in each scene, and scaling_factors.csv next to
the scenes.

The score is the mAA over rotation errors of 1 to 10 degrees and translation errors of 0.2 to 5 metres. It is
printed for each scene and as the mean of the scenes. The next columns are the AUC of the larger angular error up
to 5, 10 and 20 degrees. The mAA has a column for each step of the estimate: MAGSAC alone, with the prior on focal
lengths, with the cameras of the scene.

With --compare, several recipes run on the same pairs and are compared with the first.

With --pairs and --image-root, the pairs come from a list in the format of SuperGlue's evaluation, one line per
pair: name0 name1 turns0 turns1 K0 K1 T_0to1. E is estimated, and the AUC is the score: see docs/benchmarks.md.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    _add_sources(parser)
    options.add_matching(parser)
    _add_estimates(parser)
    options.add_run(parser, time_limit=None)
    _add_files(parser)


def _add_sources(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose pairs."""
    add = parser.add_argument
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--train-dir", type=Path, metavar="DIR", help="train side, with poses")
    text = "a list of pairs with K and poses, or a directory of .npz of MegaDepth-1500"
    source.add_argument("--pairs", type=Path, metavar="FILE", help=text)
    add("--image-root", type=Path, metavar="DIR", help="directory of the images of --pairs")
    options.add_train_side(parser)


def _add_estimates(parser: argparse.ArgumentParser) -> None:
    """Add the options that change the recipe, or compare several."""
    add = parser.add_argument
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
    text = "settings of a published evaluation, see docs/benchmarks.md; --set changes them"
    add("--protocol", choices=list(PROTOCOLS), help=text)
    text = "the matches choose between E's two rotations, as with --protocol; default: the one nearer to the truth"
    add("--in-front", action="store_true", help=text)


def _add_files(parser: argparse.ArgumentParser) -> None:
    """Add the options of results."""
    add = parser.add_argument
    add("--json", type=Path, metavar="FILE", help="write all figures, per pair too")
    text = """keep the journal there and resume from it; report.html (with --compare, a page for each recipe) shows
        the run (not with --pairs); default: a temporary directory"""
    add("--work-dir", type=Path, metavar="DIR", help=text)


def run(arguments: argparse.Namespace) -> int:
    _require_a_whole(arguments)
    root = arguments.train_dir or arguments.image_root
    # Before any work: a run of hours must not end in an output that cannot be written.
    inputs = [root, arguments.pairs]
    require_apart({"--json": arguments.json}, filter(None, inputs), arguments.work_dir)
    if arguments.pairs is None:
        scenes: Sequence[TrainScene] = options.train_side_of(arguments)
    else:
        scenes = [read_pairs(arguments.pairs, root, most=arguments.pairs_per_scene)]
    # Without a work directory, nothing is kept.
    with ExitStack() as closed:
        work_dir = arguments.work_dir or closed.enter_context(temporary_directory())
        status, figures = _match_and_score(arguments, scenes, root, work_dir)
    if figures is not None and arguments.json is not None:
        with writing(f"--json {arguments.json}"):
            arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return status


def _require_a_whole(given: argparse.Namespace) -> None:
    """Raise :class:`UserError` for options that cannot be combined."""
    if (given.pairs is None) != (given.image_root is None):
        raise UserError("--pairs and --image-root go together")
    if given.pairs is None:
        for option in ("protocol", "in_front"):
            if getattr(given, option):
                name = f"--{option.replace('_', '-')}"
                raise UserError(f"{name} needs --pairs, because it evaluates E")
    elif given.compare:
        raise UserError("--compare needs a --train-dir: it scores in metres")
    if given.compare and given.units:
        raise UserError("--units chooses from one recipe; --compare takes recipes as they are")
    if given.compare and len(given.compare) < 2:
        raise UserError("--compare needs two recipes or more")


def _match_and_score(
    arguments: argparse.Namespace, scenes: Sequence[TrainScene], root: Path, work_dir: Path
) -> tuple[int, dict[str, Any] | None]:
    """Run a recipe, or compare several recipes.

    They share a journal, so that common units run once. Return the exit status and all numbers for
    ``--json``; ``None`` if a comparison is incomplete.
    """
    compared: list[str] = arguments.compare or []
    choices = [split_mode(text) for text in compared] or [(arguments.recipe, arguments.mode)]
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    if line := missing_line(pairs):
        logger.info(line)
    if line := resolution_line(scenes):
        logger.warning(line)
    validations = []
    status = 0
    budget = options.budget_of(arguments)
    with interruptible() as interrupt, Session(work_dir, budget, interrupt).watched() as watched:
        watched.save = lambda: "the time limit passed before the scores were printed"
        # All of them first: a wrong name should not end a comparison after its first run.
        assemblies = [_assemble(arguments, interrupt, *choice) for choice in choices]
        for number, assembly in enumerate(assemblies):
            budget = options.budget_of(arguments)
            session = Session(work_dir, budget, interrupt, workers=arguments.workers)
            validation, report = _run_recipe(arguments, scenes, assembly, session)
            validations.append(validation)
            page = _page(arguments, work_dir, compared[number] if compared else "report")
            # The worst status of all runs.
            session.status = max(status, bool(trouble(report) or report.unsaved))
            status = options.finish(session, page, pairs)
            # A comparison of unequal pairs would mean nothing.
            if compared and not report.ending.is_done:
                logger.info(
                    "nothing is compared until all is done; with a --work-dir, the same command resumes"
                )
                return status or 1, None
    if not compared:
        return status, to_json(validations[0])
    logger.info("\n".join(["", *comparison_table(validations)]))
    return status, comparison_json(validations)


def _page(arguments: argparse.Namespace, work_dir: Path, name: str) -> Path | None:
    """Return the file of a run's page, if the run has one."""
    # The page draws inliers of F, but the pairs of a list have E.
    if arguments.work_dir is None or arguments.pairs is not None:
        return None
    # A recipe may be a path, and a mode is joined by a colon.
    plain = re.sub(r"[^\w.-]+", "_", name)
    return work_dir / f"{plain}.html"


def _run_recipe(
    arguments: argparse.Namespace,
    scenes: Sequence[TrainScene],
    assembly: Assembly,
    session: Session,
) -> tuple[Validation, RunReport]:
    """Run one recipe; print its summary and its scores."""
    root = arguments.train_dir or arguments.image_root
    # The published evaluations choose between the two rotations of E by the inliers.
    in_front = arguments.in_front or arguments.protocol is not None
    validation = validate(scenes, assembly, session, str(root), in_front=in_front)
    report = validation.report
    assert report is not None
    lines = []
    if left_out := left_out_line(assembly.recipe, assembly.left_out):
        lines.append(left_out)
    lines += options.plan_lines(arguments, report)
    lines += [summary(report), "", f"recipe {validation.recipe}"]
    lines += [*score_table(validation), *step_gains(validation)]
    logger.info("\n".join(lines))
    return validation, report


def _assemble(
    arguments: argparse.Namespace, interrupt: Interrupt, name: str, mode: str
) -> Assembly:
    """Return the assembly of a recipe, as changed by the command's options."""
    assembly = options.assembly_of(arguments, name, mode, interrupt)
    recipe = assembly.recipe
    if arguments.units is not None:
        recipe = recipe.with_units(arguments.units.split(","))
    if arguments.protocol is not None:
        recipe = by_protocol(recipe, arguments.protocol)
        # Again, because --set changes a protocol's settings, too.
        recipe = with_settings(recipe, options.settings_of(arguments))
    return replace(assembly, recipe=recipe)
