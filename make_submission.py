"""The front door: ``python make_submission.py --test-dir DIR`` writes ``submission.csv``."""

import sys

from mkpc_kaggle.cli import program

if __name__ == "__main__":
    program(["submit", *sys.argv[1:]])
