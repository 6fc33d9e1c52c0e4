"""The command ``demo``."""

import argparse
from pathlib import Path

from mkpc_kaggle.demo import write_demo
from mkpc_kaggle.errors import writing

HELP = """\
Render scenes of stone walls and painted boxes with known cameras, in the competition's layout: DIR/train with
poses, DIR/test without poses, and DIR/test_truth.csv to score a submission. One scene, `street`, is photographed
with lenses of 1, 2 and 4 times the focal length.

  mkpc demo --out demo
  python make_submission.py --test-dir demo/test
  mkpc score submission.csv --train-dir demo/train --truth demo/test_truth.csv
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("demo"),
        metavar="DIR",
        help="directory to write (default: demo)",
    )


def run(arguments: argparse.Namespace) -> None:
    # Rendering takes a quarter of a minute.
    print(f"rendering photographs to {arguments.out}", flush=True)
    with writing(f"--out {arguments.out}"):
        write_demo(arguments.out)
