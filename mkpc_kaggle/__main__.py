"""``python -m mkpc_kaggle``."""

import sys

from mkpc_kaggle.cli import main

if __name__ == "__main__":
    sys.exit(main())
