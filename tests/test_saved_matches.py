"""Benchmarks of estimates: matches are saved and read whole, and every estimate is scored on the same pairs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import saved_matches
from benchmarks.estimation import Score, table
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit


@dataclass(frozen=True)
class Known:
    pair: Pair


TRUE = Known(Pair("castle;b-a", "castle", Path("b.jpg"), Path("a.jpg")))
IMAGES = tuple(Image.of_array(np.zeros((height, 40, 3), np.uint8)) for height in (30, 50))


def save(folder, count):
    points = np.arange(2.0 * count, dtype=np.float32).reshape(count, 2)
    found = UnitResult(Unit(1, "sift", 1280), Matches(points, points + 1, np.ones(count)))
    path = saved_matches.file_of(folder, TRUE)
    saved_matches.write(path, PairMatch(results=(found,), images=IMAGES))
    return path


def test_matches_come_back_as_they_were_written(tmp_path):
    path = save(tmp_path, 4)
    assert path == tmp_path / "castle" / "b-a.npz"
    assert list(path.parent.iterdir()) == [path]
    found = saved_matches.read(path)
    assert [tuple(size) for size in found.sizes] == [(40, 30), (40, 50)]
    np.testing.assert_array_equal(found.matches.points1, found.matches.points0 + 1)


def test_gains_are_on_the_same_pairs_and_samples_of_a_scene_count_together():
    half = {"MAGSAC": Score((0.0, 0.5), 2.0), "scene": Score((0.5, 1.0), 30.0)}
    lines = table("sift", {"castle": [half, half]}, ["MAGSAC", "scene"])
    assert "castle (4)" in lines[0]
    assert lines[2] == "| MAGSAC | 0.250 | 0.250 |  | 1.00 |"
    assert lines[3] == "| scene | 0.750 | 0.750 | +0.5000 [+0.5000, +0.5000] | 30.00 |"
