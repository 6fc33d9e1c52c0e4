"""The command ``check``."""

import argparse
from pathlib import Path

from mkpc_kaggle.data.competition import read_test_side, submission_problem
from mkpc_kaggle.errors import plural

HELP = """\
Compare a submission with test.csv: header, ids and their order, nine finite numbers per row, not all zero.

Exit status: 0 good, 1 not good (the first problem is printed), 2 the test side cannot be read.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("submission", type=Path, help="submission to check")
    parser.add_argument(
        "--test-dir", type=Path, required=True, metavar="DIR", help="directory with test.csv"
    )


def run(arguments: argparse.Namespace) -> int:
    # An unreadable test side is an error, an unreadable submission is a problem.
    pairs = read_test_side(arguments.test_dir)
    problem = submission_problem(arguments.submission, [pair.id for pair in pairs])
    print(problem or f"good: {plural(len(pairs), 'row')}")
    return int(bool(problem))
