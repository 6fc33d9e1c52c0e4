"""Benchmarks of estimates: matches are saved and read whole, and every estimate is scored on the same pairs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks import saved_matches
from benchmarks.estimation import Score, read, table
from benchmarks.ways import WAYS, recipe_of
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult


@dataclass(frozen=True)
class Known:
    pair: Pair


TRUE = Known(Pair("castle;b-a", "castle", Path("b.jpg"), Path("a.jpg")))
IMAGES = tuple(Image.of_array(np.zeros((height, 40, 3), np.uint8)) for height in (30, 50))


def save(folder, count):
    points = np.arange(2.0 * count, dtype=np.float32).reshape(count, 2)
    found = UnitResult(WAYS["sift"][0], Matches(points, points + 1, np.ones(count)))
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


def test_two_ways_together_are_the_matches_of_both_where_both_have_a_file(tmp_path):
    save(tmp_path / "xfeat", 4)
    assert read(tmp_path, ["xfeat", "sift"], TRUE) is None
    save(tmp_path / "sift", 3)
    assert len(read(tmp_path, ["xfeat", "sift"], TRUE).matches) == 7


@pytest.mark.parametrize("way", WAYS)
def test_a_way_on_whole_images_has_the_same_sizes(way):
    units = recipe_of([way]).units
    assert set(units) == set(WAYS[way])
    if way.endswith("_whole"):
        assert [unit.name for unit in WAYS[way]] == [unit.name.replace("2:", "1:") for unit in WAYS[way[:-6]]]


def test_gains_are_on_the_same_pairs_and_samples_of_a_scene_count_together():
    half = {"MAGSAC": Score((0.0, 0.5), 2.0), "scene": Score((0.5, 1.0), 30.0)}
    lines = table("sift", {"castle": [half, half]}, ["MAGSAC", "scene"])
    assert "castle (4)" in lines[0]
    assert lines[2] == "| MAGSAC | 0.250 | 0.250 |  | 1.00 |"
    assert lines[3] == "| scene | 0.750 | 0.750 | +0.5000 [+0.5000, +0.5000] | 30.00 |"
