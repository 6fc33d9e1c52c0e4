"""a directory with known poses -> mAA and pose AUC of a recipe"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.cli import finish, options
from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    from mkpc_kaggle.data.competition import TrainScene
    from mkpc_kaggle.engine.session import Interrupt, Session
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
        help="keep the journal there (with --compare one a recipe) and go on from it; report.html beside it shows "
        "the run (not with --pairs); default: a temporary one",
    )
    parser.add_argument(
        "--submission",
        action="append",
        type=Path,
        metavar="CSV",
        help="score it and match nothing; may be repeated",
    )
    parser.add_argument("--truth", type=Path, metavar="CSV", help="which pairs its samples are (demo writes one)")


def run(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.evaluation.validate import score_submission, score_table

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
    sides = [arguments.train_dir, arguments.image_root]
    inputs = [*sides, arguments.pairs, arguments.truth, *(arguments.submission or ()), Path(arguments.recipe)]
    inputs = [path for path in inputs if path]
    options.require_apart({"--json": arguments.json}, arguments.work_dir, inputs, arguments.weights)
    with tempfile.TemporaryDirectory(prefix="mkpc-") as temporary:
        work_dir = arguments.work_dir or Path(temporary)
        scenes = _read_scenes(arguments, work_dir)
        if arguments.submission is not None:
            for submission in arguments.submission:
                print(submission)
                print("\n".join(score_table(score_submission(submission, arguments.truth, scenes))))
            return 0
        if arguments.compare is not None:
            return _compare(arguments, scenes, work_dir)
        return _match_and_score(arguments, scenes, work_dir)


def _read_scenes(arguments: argparse.Namespace, work_dir: Path) -> "tuple[TrainScene, ...]":
    from mkpc_kaggle.data.competition import read_train_side
    from mkpc_kaggle.data.pairs import read_pairs

    if arguments.pairs is not None:
        scene = read_pairs(
            arguments.pairs,
            arguments.image_root,
            arguments.estimate,
            copies=work_dir / "turned",
            most=arguments.pairs_per_scene,
        )
        return (scene,)
    return read_train_side(
        arguments.train_dir,
        scenes=filter(None, arguments.scenes.split(",")),
        min_covisibility=arguments.min_covisibility,
        pairs_per_scene=arguments.pairs_per_scene,
    )


def _match_and_score(arguments: argparse.Namespace, scenes: "tuple[TrainScene, ...]", work_dir: Path) -> int:
    from mkpc_kaggle.engine.session import interruptible
    from mkpc_kaggle.evaluation.compare import step_gains
    from mkpc_kaggle.evaluation.validate import score_table, to_json, validate
    from mkpc_kaggle.recipe import Choice, Mode
    from mkpc_kaggle.reporting.summary import trouble

    with interruptible() as interrupt:
        assembly = _assemble(arguments, Choice(arguments.recipe, Mode(arguments.mode)))
        session = _session(arguments, work_dir, interrupt)
        validation, at_rest = validate(scenes, assembly, session)
    _print_summary(arguments, validation, scenes, assembly)
    print("\n".join([*score_table(validation), *step_gains(validation)]))
    _write_json(arguments.json, to_json(validation))
    _write_report(arguments, scenes, session)
    assert validation.report is not None
    status = 128 + interrupt.signal if interrupt.signal else int(bool(trouble(validation.report)))
    return finish(status, at_rest=at_rest)


def _compare(arguments: argparse.Namespace, scenes: "tuple[TrainScene, ...]", work_dir: Path) -> int:
    from mkpc_kaggle.engine.engine import Ending
    from mkpc_kaggle.engine.session import interruptible
    from mkpc_kaggle.evaluation.compare import Comparison, comparison_json, comparison_table
    from mkpc_kaggle.evaluation.validate import score_table, validate
    from mkpc_kaggle.recipe import Choice

    validations = []
    with interruptible() as interrupt:
        choices = [Choice.parse(text) for text in arguments.compare]
        assemblies = [_assemble(arguments, choice) for choice in choices]
        for choice, assembly in zip(choices, assemblies, strict=True):
            session = _session(arguments, work_dir / choice.folder, interrupt)
            validation, at_rest = validate(scenes, assembly, session)
            _print_summary(arguments, validation, scenes, assembly)
            print("\n".join(score_table(validation)))
            _write_report(arguments, scenes, session)
            print()
            if validation.report is None or validation.report.ending is not Ending.COMPLETE:
                print("nothing is compared before all is done; with a --work-dir, the same command goes on")
                return finish(128 + interrupt.signal if interrupt.signal else 1, at_rest=at_rest)
            validations.append(validation)
    comparison = Comparison(tuple(validations))
    print("\n".join(comparison_table(comparison)))
    _write_json(arguments.json, comparison_json(comparison))
    return finish(0, at_rest=at_rest)


def _session(arguments: argparse.Namespace, work_dir: Path, interrupt: "Interrupt") -> "Session":
    from mkpc_kaggle.engine.session import Session

    return Session(work_dir, options.budget_of(arguments), interrupt, workers=arguments.workers)


def _assemble(arguments: argparse.Namespace, choice: "Choice") -> "Assembly":
    from dataclasses import replace

    assembly = options.assembly_of(arguments, choice)
    chosen = with_units(assembly.recipe, arguments.units)
    return replace(assembly, recipe=_with_estimator(chosen, arguments))


def with_units(recipe: "Recipe", wanted: str | None) -> "Recipe":
    """The recipe with the units of these names alone, in this order; all of them where none are named."""
    from dataclasses import replace

    known, names = {unit.name: unit for unit in recipe.units}, wanted.split(",") if wanted is not None else []
    for name in names:
        if name not in known:
            raise UserError(f"--units: recipe {recipe.name!r} has no unit {name!r}; it has {', '.join(known)}")
    return replace(recipe, units=tuple(known[name] for name in names)) if names else recipe


def _with_estimator(recipe: "Recipe", arguments: argparse.Namespace) -> "Recipe":
    """The recipe with the robust method and threshold that the command names."""
    try:
        return recipe.with_magsac(arguments.method, arguments.threshold)
    except ValueError as error:
        raise UserError(f"--threshold: {error}") from error


def _print_summary(
    arguments: argparse.Namespace, validation: "Validation", scenes: "tuple[TrainScene, ...]", assembly: "Assembly"
) -> None:
    from mkpc_kaggle.reporting.summary import summary

    pairs = [true.pair for scene in scenes for true in scene.pairs]
    assert validation.report is not None
    if arguments.explain:
        print("\n".join(["plan:", *map(str, validation.report.explanations)]))
    print(summary(pairs, validation.report, assembly.left_out))
    print(f"\nrecipe {validation.recipe}")


def _write_report(arguments: argparse.Namespace, scenes: "tuple[TrainScene, ...]", session: "Session") -> None:
    """The report of a run whose journal is kept; its inliers are of F, so there is none where E was estimated."""
    from mkpc_kaggle.reporting.report import report_run

    if arguments.work_dir is not None and arguments.pairs is None:
        pairs = [true.pair for scene in scenes for true in scene.pairs]
        page = session.work_dir / "report.html"
        print(report_run(session.work_dir, page, session.must_end(), pairs), flush=True)


def _write_json(path: Path | None, values: dict[str, Any]) -> None:
    if path is not None:
        try:
            path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise UserError(f"--json {path} cannot be written: {error.strerror}") from error
