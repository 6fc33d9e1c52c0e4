"""The command ``score``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.evaluation.validate import score_submission, score_table, to_json

HELP = """\
Score submissions whose truth is known, by the rules of 2022. Nothing is matched. Each sample is a
pair of the train side. The score is the mAA over rotation errors of 1 to 10 degrees and translation
errors of 0.2 to 5 metres.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("submissions", nargs="+", type=Path, metavar="SUBMISSION.csv", help="files to score")
    add(
        "--train-dir",
        type=Path,
        required=True,
        metavar="DIR",
        help="the train side, with poses",
    )
    text = "the pairs of the samples; `demo` writes an example"
    add("--truth", type=Path, required=True, metavar="CSV", help=text)
    options.add_train_side(parser)
    options.add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    inputs = [arguments.train_dir, arguments.truth, *arguments.submissions]
    require_apart({"--json": arguments.json}, inputs, None)
    scenes = options.train_side_of(arguments)
    figures = []
    for submission in arguments.submissions:
        validation = score_submission(submission, arguments.truth, scenes)
        print("\n".join([str(submission), *score_table(validation)]))
        figures.append(to_json(validation))
    options.write_json(arguments, figures)
