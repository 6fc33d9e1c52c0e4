"""The template of a matcher runs as a file of the package and as a program."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pictures import write_two_views
from sklearn.datasets import load_sample_image

from mkpc_kaggle import Recipe, TwoStageMatcher
from mkpc_kaggle.matchers.registry import MATCHERS
from mkpc_kaggle.recipe import Unit

TEMPLATE = Path(__file__).parents[2] / "docs" / "own_matcher.py"


def test_the_template_of_a_matcher_runs_as_a_file_of_the_package(monkeypatch):
    monkeypatch.syspath_prepend(TEMPLATE.parent)
    monkeypatch.setitem(MATCHERS, "orb", TEMPLATE.stem)
    image = load_sample_image("china.jpg")
    match = TwoStageMatcher(Recipe((Unit(1, "orb", 640), Unit(2, "orb", 640))))(image, image)
    assert match.estimate.inlier_count > 500
    # Without keypoints, OpenCV returns None instead of descriptors.
    flat = np.zeros_like(image)
    with pytest.warns(RuntimeWarning, match="no F was found"):
        assert not TwoStageMatcher(Recipe((Unit(1, "orb", 640),)))(image, flat).estimate.ok


def test_the_template_of_a_matcher_runs_as_a_program(tmp_path):
    write_two_views(tmp_path)
    command = [sys.executable, TEMPLATE, "a.jpg", "b.jpg"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count = int(done.stdout.split(" inliers")[0])
    assert count > 100
