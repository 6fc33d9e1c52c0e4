"""The command ``check``."""

import argparse
from pathlib import Path

from mkpc_kaggle.data.competition import read_test_side, submission_problems

HELP = """\
Compare a submission with test.csv: header, ids and their order, nine finite numbers per row.
Exit status: 0 good, 1 not good (one problem per line), 2 the test side cannot be read.
"""
MAX_LINES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("submission", type=Path)
    parser.add_argument("--test-dir", type=Path, required=True, metavar="DIR")


def run(arguments: argparse.Namespace) -> int:
    pairs = read_test_side(arguments.test_dir)
    problems = submission_problems(arguments.submission, [pair.id for pair in pairs])
    more = [f"... and {len(problems) - MAX_LINES} more"] if len(problems) > MAX_LINES else []
    verdict = (
        f"{arguments.submission}: {len(problems)} problems"
        if problems
        else f"good: {len(pairs)} rows"
    )
    print("\n".join([*problems[:MAX_LINES], *more, verdict]))
    return 1 if problems else 0
