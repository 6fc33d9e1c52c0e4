"""Shared helpers: the material of ``../shared``, commands, recipes and folders."""

import json
from pathlib import Path
from typing import Any

import pytest

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import read_test_side, submission_problem

SHARED = Path(__file__).resolve().parents[3] / "shared"
DATA = SHARED / "data"
WEIGHTS = SHARED / "weights"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no pictures in {DATA}")
needs_weights = pytest.mark.skipif(
    not WEIGHTS.is_dir(), reason=f"no checkpoints in {WEIGHTS}"
)


def contents(directory: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in directory.rglob("*")
        if path.is_file()
    }


def run_command(*words: object) -> int:
    """Run a command of the package in this process; return its exit status."""
    return main([*map(str, words)])


def problem_of(submission: Path, test_dir: Path) -> str:
    return submission_problem(submission, [pair.id for pair in read_test_side(test_dir)])


def scores_of(out: Path, *options: object) -> dict[str, Any]:
    """Run ``validate`` with these options in this process; return what it writes to the JSON file
    ``out``.
    """
    # In this process: a worker would import torch again for each test.
    assert run_command("validate", "--workers", 0, "--json", out, *options) == 0
    return json.loads(out.read_text())


def write_recipe(path: Path, *units: tuple[int, int], more: str = "") -> Path:
    """Write a recipe with a unit of SIFT for each stage and long side."""
    texts = [
        f'{{ stage = {stage}, matcher = "sift", long_side = {side} }}'
        for stage, side in units
    ]
    path.write_text(f"units = [{', '.join(texts)}]\n{more}")
    return path


def write_small_recipe(directory: Path) -> Path:
    magsac = "[magsac]\nmax_iterations = 5000\n"
    return write_recipe(directory / "small.toml", (1, 320), (2, 400), more=magsac)
