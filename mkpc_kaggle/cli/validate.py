"""a directory with known poses -> mAA and pose AUC of a recipe"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.cli import leave, options

if TYPE_CHECKING:
    from mkpc_kaggle.competition import Scene

HELP = """\
Run a recipe, with the engine that makes submissions, on a train side (calibration.csv, pair_covisibility.csv
and images/ in each scene, scaling_factors.csv beside the scenes), and score it as the competition does: mAA
over rotation errors of 1 to 10 degrees and translation errors of 0.2 to 5 metres, for each scene, then the
mean of the scenes; beside it the AUC of the larger angular error up to 5, 10 and 20 degrees.

With --submission and --truth nothing is matched: the files are scored.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--train-dir", type=Path, required=True, metavar="DIR")
    parser.add_argument("--scenes", default="", metavar="A,B", help="default: all")
    parser.add_argument("--pairs-per-scene", type=int, metavar="N", help="evenly spread; default: all")
    parser.add_argument("--min-covisibility", type=float, default=0.1, help="default: 0.1, as in the competition")
    options.add_matching(parser)
    options.add_mode(parser)
    options.add_time_limit(parser, default=None)
    options.add_engine(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures, per pair too")
    parser.add_argument(
        "--work-dir", type=Path, metavar="DIR", help="keep the journal there; default: a temporary one"
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
    from mkpc_kaggle.competition import read_train_side
    from mkpc_kaggle.errors import UserError
    from mkpc_kaggle.validate import score_submission, score_table

    if (arguments.submission is None) != (arguments.truth is None):
        raise UserError("--submission and --truth go together")
    scenes = read_train_side(
        arguments.train_dir,
        scenes=filter(None, arguments.scenes.split(",")),
        min_covisibility=arguments.min_covisibility,
        pairs_per_scene=arguments.pairs_per_scene,
    )
    if arguments.submission is not None:
        for submission in arguments.submission:
            print(submission)
            print("\n".join(score_table(score_submission(submission, arguments.truth, scenes))))
        return 0
    with tempfile.TemporaryDirectory(prefix="mkpc-") as temporary:
        return _match_and_score(arguments, scenes, arguments.work_dir or Path(temporary))


def _match_and_score(arguments: argparse.Namespace, scenes: "tuple[Scene, ...]", work_dir: Path) -> int:
    from mkpc_kaggle.assembly import Licence, assemble
    from mkpc_kaggle.recipe import Mode
    from mkpc_kaggle.run.session import Session, interruptible
    from mkpc_kaggle.run.summary import summary
    from mkpc_kaggle.validate import score_table, to_json, validate

    with interruptible() as interrupt:
        assembly = assemble(
            arguments.recipe,
            weights=arguments.weights,
            device=arguments.device,
            precision=arguments.precision,
            mode=Mode(arguments.mode),
            licence=Licence(arguments.licence),
        )
        session = Session(work_dir, options.budget_of(arguments), interrupt, workers=arguments.workers)
        validation, at_rest = validate(scenes, assembly, session)
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    assert validation.report is not None
    if arguments.explain:
        print("\n".join(["plan:", *map(str, validation.report.explanations)]))
    print(summary(pairs, validation.report, assembly.left_out))
    print(f"\nrecipe {validation.recipe}")
    print("\n".join(score_table(validation)))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(to_json(validation), indent=1) + "\n", encoding="utf-8")
    return leave(128 + interrupt.signal if interrupt.signal else 0, at_rest=at_rest)
