"""a directory with known poses -> mAA and pose AUC of a recipe"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.cli import options
from mkpc_kaggle.engine.console import say
from mkpc_kaggle.errors import UserError, writing

if TYPE_CHECKING:
    from mkpc_kaggle.data.competition import TrainScene
    from mkpc_kaggle.engine.session import Interrupt
    from mkpc_kaggle.evaluation.validate import Validation
    from mkpc_kaggle.pipeline.assembly import Assembly
    from mkpc_kaggle.recipe import Choice, Recipe

HELP = """\
Run a recipe, with the engine that makes submissions, on a train side (calibration.csv, pair_covisibility.csv
and images/ in each scene, scaling_factors.csv beside the scenes), and score it as the competition does: mAA
over rotation errors of 1 to 10 degrees and translation errors of 0.2 to 5 metres, for each scene, then the
mean of the scenes; beside it the AUC of the larger angular error up to 5, 10 and 20 degrees. The mAA has a column
for each step of the estimate: MAGSAC alone, with the prior on focal lengths, with the cameras of the scene.

With --compare, several recipes run on the same pairs; each is compared with the first.

With --pairs and --image-root the pairs come from a list in the format of SuperGlue's evaluation (a line a pair:
name0 name1 turns0 turns1 K0 K1 T_0to1), E is estimated, and the AUC is what counts: see docs/benchmarks.md.

With --submission and --truth nothing is matched: the files are scored.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--train-dir", type=Path, metavar="DIR")
    source.add_argument("--pairs", type=Path, metavar="FILE", help="a list of pairs with K and poses")
    parser.add_argument("--image-root", type=Path, metavar="DIR", help="where the images of --pairs lie")
    parser.add_argument("--scenes", default="", metavar="A,B", help="of --train-dir; default: all")
    parser.add_argument(
        "--pairs-per-scene", type=options.at_least_1, metavar="N", help="evenly spread; default: all"
    )
    parser.add_argument(
        "--min-covisibility", type=float, default=0.1, help="of --train-dir; default: 0.1, as in the competition"
    )
    options.add_matching(parser)
    options.add_mode(parser)
    options.add_no_scenes(parser)
    parser.add_argument(
        "--units",
        metavar="A,B",
        help="only these of the recipe's units, in this order, such as 1:sift@1536; default: all",
    )
    parser.add_argument(
        "--compare",
        nargs="+",
        metavar="RECIPE[:MODE]",
        help="run these instead of --recipe and --mode, and give the gain of each over the first with its 95 %% "
        "interval; such as classical:whole-images classical",
    )
    parser.add_argument(
        "--estimate", choices=["E", "F"], default="E", help="what to estimate on --pairs (default: E)"
    )
    parser.add_argument("--method", choices=["magsac", "ransac"], help="default: the recipe's")
    parser.add_argument(
        "--threshold", type=float, metavar="PIXELS", help="of the method; for E divided by the mean focal length"
    )
    options.add_time_limit(parser, default=None)
    options.add_engine(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures, per pair too")
    parser.add_argument(
        "--work-dir",
        type=Path,
        metavar="DIR",
        help="keep the journal there (with --compare, a journal for each recipe) and go on from it; report.html "
        "beside it shows the run (not with --pairs); default: a temporary directory",
    )
    parser.add_argument(
        "--submission",
        action="append",
        type=Path,
        metavar="CSV",
        help="score it and match nothing; may be repeated",
    )
    parser.add_argument(
        "--truth", type=Path, metavar="CSV", help="which pairs its samples are (`demo` writes such a table)"
    )


def run(arguments: argparse.Namespace) -> int:
    _require_a_whole(arguments)
    sides = [arguments.train_dir, arguments.image_root]
    inputs = [*sides, arguments.pairs, arguments.truth, *(arguments.submission or ())]
    options.require_apart({"--json": arguments.json}, arguments.work_dir, [path for path in inputs if path])
    with tempfile.TemporaryDirectory(prefix="mkpc-") as temporary:
        work_dir = arguments.work_dir or Path(temporary)
        scenes = _read_scenes(arguments, work_dir)
        if arguments.submission is not None:
            return _score_submissions(arguments, scenes)
        return _match_and_score(arguments, scenes, work_dir)


def _require_a_whole(arguments: argparse.Namespace) -> None:
    """Raise :class:`UserError` for options that do not go together."""
    if (arguments.submission is None) != (arguments.truth is None):
        raise UserError("--submission and --truth go together")
    if (arguments.pairs is None) != (arguments.image_root is None):
        raise UserError("--pairs and --image-root go together")
    if arguments.pairs is not None and (arguments.submission or arguments.compare):
        raise UserError("--submission and --compare need a --train-dir: they score in metres, which --pairs lacks")
    if arguments.compare is not None and arguments.units is not None:
        raise UserError("--units chooses from one recipe; --compare takes recipes as they are")
    if arguments.compare is not None and len(arguments.compare) < 2:
        raise UserError(f"--compare needs two recipes or more, not only {arguments.compare[0]}")


def _read_scenes(arguments: argparse.Namespace, work_dir: Path) -> "tuple[TrainScene, ...]":
    from mkpc_kaggle.data.competition import read_train_side
    from mkpc_kaggle.data.pairs import read_pairs

    if arguments.pairs is not None:
        copies, most = work_dir / "turned", arguments.pairs_per_scene
        return (read_pairs(arguments.pairs, arguments.image_root, arguments.estimate, copies=copies, most=most),)
    return read_train_side(
        arguments.train_dir,
        scenes=filter(None, arguments.scenes.split(",")),
        min_covisibility=arguments.min_covisibility,
        pairs_per_scene=arguments.pairs_per_scene,
    )


def _score_submissions(arguments: argparse.Namespace, scenes: "tuple[TrainScene, ...]") -> int:
    from mkpc_kaggle.evaluation.validate import score_submission, score_table

    for submission in arguments.submission:
        say("\n".join([str(submission), *score_table(score_submission(submission, arguments.truth, scenes))]))
    return 0


def _match_and_score(arguments: argparse.Namespace, scenes: "tuple[TrainScene, ...]", work_dir: Path) -> int:
    """Run a recipe, or several to compare, each then with a journal in a directory of its own."""
    from mkpc_kaggle.engine.engine import Ending
    from mkpc_kaggle.engine.session import interruptible
    from mkpc_kaggle.evaluation.compare import Comparison, comparison_json, comparison_table
    from mkpc_kaggle.evaluation.validate import to_json
    from mkpc_kaggle.recipe import Choice, Mode
    from mkpc_kaggle.reporting.summary import trouble

    compared = arguments.compare is not None
    choices = [Choice.parse(text) for text in arguments.compare or ()]
    choices = choices or [Choice(arguments.recipe, Mode(arguments.mode))]
    validations = []
    with interruptible() as interrupt:
        assemblies = [_assemble(arguments, choice) for choice in choices]
        for choice, assembly in zip(choices, assemblies, strict=True):
            place = work_dir / choice.folder if compared else work_dir
            validation = _validate(arguments, scenes, assembly, place, interrupt)
            validations.append(validation)
            assert validation.report is not None
            status = 128 + interrupt.signal if interrupt.signal else int(bool(trouble(validation.report)))
            if compared and validation.report.ending != Ending.COMPLETE:
                say("nothing is compared before all is done; with a --work-dir, the same command goes on")
                return status or 1
    figures = to_json(validations[0])
    if compared:
        comparison, status = Comparison(tuple(validations)), 0
        say("\n".join(["", *comparison_table(comparison)]))
        figures = comparison_json(comparison)
    if arguments.json is not None:
        with writing(f"--json {arguments.json}"):
            arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return status


def _validate(
    arguments: argparse.Namespace,
    scenes: "tuple[TrainScene, ...]",
    assembly: "Assembly",
    work_dir: Path,
    interrupt: "Interrupt",
) -> "Validation":
    """Run a recipe and print its summary and its scores."""
    from mkpc_kaggle.engine.session import Session
    from mkpc_kaggle.evaluation.compare import step_gains
    from mkpc_kaggle.evaluation.validate import score_table, validate
    from mkpc_kaggle.reporting.report import report_run
    from mkpc_kaggle.reporting.summary import left_out_line, summary

    session = Session(work_dir, options.budget_of(arguments), interrupt, workers=arguments.workers)
    validation = validate(scenes, assembly, session)
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    assert validation.report is not None
    explained = ["plan:", *map(str, validation.report.explanations)] if arguments.explain else []
    left_out = filter(None, [left_out_line(assembly.left_out)])
    told = [*left_out, *explained, summary(pairs, validation.report), "", f"recipe {validation.recipe}"]
    say("\n".join([*told, *score_table(validation), *step_gains(validation)]))
    # The report's inliers are of F: there is none for a list of pairs, whose E is estimated.
    if arguments.work_dir is not None and arguments.pairs is None:
        say(report_run(work_dir, work_dir / "report.html", session.must_end(), pairs))
    return validation


def _assemble(arguments: argparse.Namespace, choice: "Choice") -> "Assembly":
    """The parts of a run of a recipe, with the units and the robust method that the command names."""
    assembly = options.assembly_of(arguments, choice)
    recipe = with_units(assembly.recipe, arguments.units)
    try:
        return replace(assembly, recipe=recipe.with_magsac(arguments.method, arguments.threshold))
    except ValueError as error:
        raise UserError(f"--threshold: {error}") from error


def with_units(recipe: "Recipe", wanted: str | None) -> "Recipe":
    """The recipe with the units of these names alone, in this order; all of them if none are named."""
    known, names = {unit.name: unit for unit in recipe.units}, wanted.split(",") if wanted is not None else []
    for name in names:
        if name not in known:
            raise UserError(f"--units: recipe {recipe.name!r} has no unit {name!r}; it has {', '.join(known)}")
    return replace(recipe, units=tuple(known[name] for name in names)) if names else recipe
