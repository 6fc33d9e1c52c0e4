"""``python -m mkpc_kaggle``."""

import sys

if __name__ == "__main__":
    try:  # imports take a while, and Ctrl-C is no error
        from mkpc_kaggle.cli import program
    except KeyboardInterrupt:
        sys.exit(130)
    program()
