"""The front door: ``python make_submission.py --test-dir DIR`` writes ``submission.csv``."""

import sys

from mkpc_kaggle.cli import main

if __name__ == "__main__":
    sys.exit(main(["submit", *sys.argv[1:]]))
