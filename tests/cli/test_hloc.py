"""Keypoints and matches in hloc's layout: of a pair, and of a folder."""

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import run_command, write_recipe
from sklearn.datasets import load_sample_image

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.data.hloc import HlocPair, write_hloc

h5py = pytest.importorskip("h5py", reason="files for hloc need the extra h5")


@pytest.fixture
def pictures(tmp_path: Path, monkeypatch) -> Path:
    """Four overlapping parts of a photograph in DIR/images."""
    monkeypatch.chdir(tmp_path)
    photograph = load_sample_image("china.jpg")[..., ::-1]
    (tmp_path / "images").mkdir()
    for number in range(4):
        part = photograph[60:300, 20 * number : 400 + 20 * number]
        cv2.imwrite(f"images/{number}.png", part)
    return tmp_path


def read(path: Path, name0: str, name1: str):
    """The keypoints of two images, and the matches of the pair, as hloc's readers look them up."""
    with h5py.File(path, "r") as file:
        pair = file[f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"]
        matches = pair["matches0"][()]
        points = [file[name]["keypoints"][()] for name in (name0, name1)]
        sizes = [tuple(file[name]["image_size"][()]) for name in (name0, name1)]
        return points, matches, pair["matching_scores0"][()], sizes


def rows_of(points: list, matches: np.ndarray) -> set:
    first = np.flatnonzero(matches >= 0)
    both = np.hstack([points[0][first], points[1][matches[first]]])
    return set(map(tuple, both.tolist()))


def test_a_pair_is_saved_for_hloc(pictures):
    recipe = write_recipe(pictures / "r.toml", (1, 400))
    command = ["match", "images/0.png", "images/1.png", "--recipe", recipe, "--device", "cpu"]
    assert run_command(*command, "--save", "pair.h5") == 0
    points, matches, scores, sizes = read(pictures / "pair.h5", "0.png", "1.png")
    match = TwoStageMatcher(recipe)("images/0.png", "images/1.png")
    expected = np.hstack([match.matches.points0, match.matches.points1])
    assert rows_of(points, matches) == set(map(tuple, expected.tolist()))
    np.testing.assert_array_equal(points[0], match.keypoints.points0)
    assert ((scores > 0) == (matches >= 0)).all()
    assert sizes == [(400, 240), (400, 240)]
    assert run_command(*command, "--save", "pair.hdf") == 2


def test_of_several_matches_of_a_keypoint_the_surest_counts(tmp_path):
    keypoints = {"a/0.png": np.zeros((3, 2), np.float32), "b/1.png": np.ones((2, 2), np.float32)}
    rows = np.array([[0, 1], [0, 0], [2, 1]])
    pair = HlocPair("a/0.png", "b/1.png", rows, np.array([0.25, 0.5, 0.75], np.float32))
    write_hloc(tmp_path / "x.h5", keypoints, dict.fromkeys(keypoints, (4, 3)), [pair])
    _, matches, scores, _ = read(tmp_path / "x.h5", "a/0.png", "b/1.png")
    assert matches.tolist() == [0, -1, 1]
    assert scores.tolist() == [0.5, 0, 0.75]


def test_a_folder_is_exported_as_its_database_has_it(pictures, capsys):
    recipe = write_recipe(pictures / "r.toml", (1, 400))
    command = ["reconstruct", "images", "--out", "out", "--recipe", recipe, "--device", "cpu"]
    assert run_command(*command, "--export", "x.npz") == 2
    # Parts of one photograph make no model.
    run_command(*command, "--workers", 0, "--export", "x.h5")
    assert "x.h5: keypoints of 4 images, matches of 6 pairs" in capsys.readouterr().out
    points, matches, _, sizes = read(pictures / "x.h5", "0.png", "1.png")
    assert sizes[0] == (400, 240)
    with closing(sqlite3.connect("out/database.db")) as database:
        counts = dict(
            database.execute("SELECT name, rows FROM keypoints JOIN images USING (image_id)")
        )
        (stored,) = database.execute("SELECT rows FROM matches WHERE pair_id = 2147483649")
    assert len(points[0]) == counts["0.png"]
    assert (matches >= 0).sum() == stored[0]
    # The parts are shifted by 20 pixels.
    first = np.flatnonzero(matches >= 0)
    shift = points[0][first] - points[1][matches[first]]
    np.testing.assert_allclose(np.median(shift, axis=0), [20, 0], atol=0.1)
    # Pixel centres are at integers: keypoints are those of the matcher, up to merging.
    match = TwoStageMatcher(recipe)("images/0.png", "images/1.png")
    distances = np.abs(points[0][:, None] - match.matches.points0[None]).max(axis=2).min(axis=0)
    assert np.median(distances) < 0.05
