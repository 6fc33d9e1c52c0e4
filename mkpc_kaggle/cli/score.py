"""The command ``score``."""

import argparse
import json
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.evaluation.imc2025 import score_imc2025, score_lines
from mkpc_kaggle.evaluation.validate import score_submission, score_table, to_json

HELP = """\
Score submissions whose truth is known. Nothing is matched.

With --train-dir and --truth, by the rules of 2022. Each sample is a pair of the train side. The score is the mAA
over rotation errors of 1 to 10 degrees and translation errors of 0.2 to 5 metres. With --imc2025, files of
`reconstruct --format imc2025` by the rules of 2025: mAA of the camera centres, and the share of right images in
the clusters.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("submissions", nargs="+", type=Path, metavar="SUBMISSION.csv", help="files to score")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--train-dir", type=Path, metavar="DIR", help="the train side, with poses")
    text = "a directory with train_labels.csv and train_thresholds.csv"
    source.add_argument("--imc2025", type=Path, metavar="DIR", help=text)
    text = "with --train-dir: the pairs of its samples; `demo` writes an example"
    add("--truth", type=Path, metavar="CSV", help=text)
    options.add_train_side(parser)
    add("--json", type=Path, metavar="FILE", help="write all figures of --train-dir, per pair too")


def run(arguments: argparse.Namespace) -> None:
    if arguments.imc2025 is not None:
        if arguments.truth is not None or arguments.json is not None:
            raise UserError(
                "--imc2025 has its own truth and prints scores: leave --truth and --json out"
            )
        for submission in arguments.submissions:
            scores = score_imc2025(arguments.imc2025, submission)
            print("\n".join([str(submission), *score_lines(scores)]))
        return
    if arguments.truth is None:
        raise UserError("--train-dir needs --truth, the pairs of the samples")
    inputs = [arguments.train_dir, arguments.truth, *arguments.submissions]
    require_apart({"--json": arguments.json}, inputs, None)
    scenes = options.train_side_of(arguments)
    figures = []
    for submission in arguments.submissions:
        validation = score_submission(submission, arguments.truth, scenes)
        print("\n".join([str(submission), *score_table(validation)]))
        figures.append(to_json(validation))
    if arguments.json is not None:
        written = {"submissions": figures} if len(figures) > 1 else figures[0]
        with writing(f"--json {arguments.json}"):
            arguments.json.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")
