"""Every snippet of docs/python.md runs, in the order of the page."""

import re
from pathlib import Path

import matplotlib as mpl
import pytest
from genuine import GENUINE
from pictures import write_two_views

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text(
    encoding="utf-8"
)
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
GENUINE_BLOCKS = [block for block in BLOCKS if 'weights="weights"' in block]
OURS = [block for block in BLOCKS if block not in GENUINE_BLOCKS]


@pytest.fixture
def names(tmp_path, monkeypatch, nowhere_else) -> dict:
    """The names that snippets have in common, in a directory with two parts of a photograph."""
    write_two_views(tmp_path)
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")
    return {}


def run(block: str, names: dict) -> None:
    exec(compile(block, f"docs/python.md: {block.splitlines()[0]}", "exec"), names)


def test_the_page_runs_from_top_to_bottom(names, tmp_path):
    assert len(OURS) >= 7
    for block in OURS:
        run(block, names)
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert names["match"].estimate.inlier_count > 50
    assert names["essential"].estimate.model == "E"
    assert not names["nothing"].estimate
    assert len(names["tables"].pairs) == 3


@pytest.mark.genuine
def test_our_lines_for_users_of_lightglue_run_with_genuine_weights(
    names, tmp_path, monkeypatch
):
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    (tmp_path / "weights").symlink_to(GENUINE)
    assert len(GENUINE_BLOCKS) == 1
    run(GENUINE_BLOCKS[0], names)
    assert len(names["points0"]) == len(names["points1"]) > 200
