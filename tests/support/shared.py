"""Where the material beside the repository lies, ``../shared``; tests that need it are skipped without it."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"
DATA = SHARED / "data"
WEIGHTS = SHARED / "weights"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no pictures in {DATA}")
needs_weights = pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"no checkpoints in {WEIGHTS}")
