"""``report.html`` of runs with known results."""

import re
import shutil
import subprocess
from dataclasses import replace
from math import inf

import numpy as np
import pandas as pd
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs

from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.reporting import page as module
from mkpc_kaggle.reporting.page import page, report_run
from mkpc_kaggle.reporting.view import view

# As a name of a file, and in all other texts that come from outside
EVIL = '<script>alert("$x$")</script>'
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run over pairs of which the second cannot be read, and its pairs."""
    home = tmp_path_factory.mktemp("made")
    pairs = write_pairs(home / "images", 4)
    pairs[1] = replace(pairs[1], id=EVIL)
    pairs[1].images[1].write_bytes(b"")
    run(pairs, THREE_UNITS, RectifiedMatcher(), home / "work")
    return home / "work", pairs


def cameras(count=4):
    """Cameras on a line, which look ahead."""
    rows = []
    for number in range(count):
        t = -np.array([float(number), 0, 0])
        K = np.array([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])
        rows.append(
            ("batch", 0, f"{number}.png", 80, 60, 9, 80.0, K, np.eye(3), t, "PINHOLE")
        )
    names = ["batch", "model", "image", "width", "height", "points", "focal", "K", "R", "t"]
    return pd.DataFrame(rows, columns=[*names, "camera_model"])


def test_a_page_has_the_counts_what_failed_the_tables_and_pictures(made):
    work, pairs = made
    text = page(results(work), pairs)
    assert re.search("<h1>complete after .*: 3 of 4 pairs with an F</h1>", text)
    assert "1 pair without an F (" in text
    assert text.count("data:image/jpeg;base64,") == 3
    assert "1:rectified" in text and "<h2>Units</h2>" in text
    # No request, and no script of a file's name
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_a_page_without_time_for_pictures_has_none(made, tmp_path, monkeypatch):
    work, pairs = made
    path = tmp_path / "report.html"
    assert report_run(work, path, -inf, pairs).startswith("no report, the time is up")
    assert not path.exists()
    monkeypatch.setattr(module, "DRAWING_S", inf)
    assert report_run(work, path, inf, pairs) == f"report: {path}"
    assert "data:image" not in path.read_text()


def test_an_error_costs_the_pictures_and_never_the_run(made, tmp_path, monkeypatch):
    work, pairs = made
    path = tmp_path / "report.html"
    monkeypatch.setattr(module, "draw_strip", None)
    line = report_run(work, path, inf, pairs)
    assert line.startswith("warning: no report, or a report without pictures")
    assert "<h1>" in path.read_text()
    assert report_run(tmp_path / "none", path, inf).startswith("warning: no report")


def test_cameras_are_outlined_where_they_are_and_named():
    pytest.importorskip("plotly")
    far = np.full((1, 3), 1e6)
    wall = np.random.default_rng(0).uniform((0, -3, 5), (3, -1, 6), (100, 3))  # above them
    points, frusta, centres = view(cameras(), np.vstack([wall, far])).data
    assert list(centres.text) == ["0.png", "1.png", "2.png", "3.png"]
    # x right, y ahead, z up
    np.testing.assert_allclose(np.array([centres.x, centres.y, centres.z]).T[3], (3, 0, 0))
    assert len(points.x) <= 100
    assert min(points.y) > 4
    assert min(points.z) > 0

    # Pictures are ahead, at a share of the distance between cameras, or of the extent.
    assert np.nanmax(frusta.y) == pytest.approx(0.4, abs=0.1)
    assert np.nanmax(frusta.x) == pytest.approx(3 + np.nanmax(frusta.y) / 2, abs=0.01)


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here: apt-get install chromium")
def test_the_view_in_a_page_opens_without_a_network(made, tmp_path):
    pytest.importorskip("plotly")
    work, _ = made
    points = {("batch", 0): np.random.default_rng(0).uniform(0, 4, (50, 3))}
    path = tmp_path / "report.html"
    path.write_text(page(replace(results(work), cameras=cameras(), points=points)))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000"]
    command = [CHROMIUM, *options, "--dump-dom", path.as_uri()]
    shown = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=120
    ).stdout
    # Plotly has made its parts.
    assert "gl-container" in shown
