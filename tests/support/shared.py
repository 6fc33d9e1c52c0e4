"""What tests share: the material beside the repository, in ``../shared``, and what is in a folder."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"
DATA = SHARED / "data"
WEIGHTS = SHARED / "weights"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no pictures in {DATA}")
needs_weights = pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"no checkpoints in {WEIGHTS}")


def contents(directory: Path) -> dict[str, bytes]:
    """The files below a directory."""
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}
