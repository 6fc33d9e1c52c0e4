"""``python -m mkpc_kaggle``."""

from mkpc_kaggle.cli import program

if __name__ == "__main__":
    program()
