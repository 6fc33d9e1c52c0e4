"""The command ``check``."""

import argparse
from pathlib import Path

from mkpc_kaggle.data.competition import read_test_side, submission_problems, submission_warnings
from mkpc_kaggle.errors import plural

HELP = """\
Compare a submission with test.csv: header, ids and their order, nine finite numbers per row.
Cells of nine numbers that are no fundamental matrix (rank 3, or rounded to zero) are warned of.
Exit status: 0 good, 1 not good (one problem per line), 2 the test side cannot be read.
"""
MAX_LINES = 20  # of problems; a wrong file may have one in each of a hundred thousand rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("submission", type=Path, help="submission to check")
    parser.add_argument(
        "--test-dir", type=Path, required=True, metavar="DIR", help="directory with test.csv"
    )


def run(arguments: argparse.Namespace) -> int:
    # An unreadable test side is an error, an unreadable submission is a problem.
    pairs = read_test_side(arguments.test_dir)
    problems = submission_problems(arguments.submission, [pair.id for pair in pairs])
    if not problems:
        print(f"good: {plural(len(pairs), 'row')}")
        for text in submission_warnings(arguments.submission):
            print(f"warning: {text}")
        return 0
    lines = problems[:MAX_LINES]
    if len(problems) > MAX_LINES:
        lines.append(f"... and {len(problems) - MAX_LINES} more")
    lines.append(f"{arguments.submission}: {plural(len(problems), 'problem')}")
    print("\n".join(lines))
    return 1
