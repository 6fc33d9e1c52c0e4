"""The command ``journal``."""

import argparse
from pathlib import Path

from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.reporting.summary import summary

HELP = """\
Show how far a run is, also while it is running. DIR is the run's work directory, NAME.work next to
the submission. In Python, mkpc_kaggle.results(DIR) has its results as DataFrames.

Exit status: 0 done, 2 the journal does not exist.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "work_dir", type=Path, metavar="DIR", help="work directory of the run"
    )


def run(arguments: argparse.Namespace) -> None:
    print(summary(results(arguments.work_dir)))  # refuses a directory without a run
