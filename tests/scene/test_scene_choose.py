"""A pair keeps its F where the evidence of all its units speaks against the scene's."""

from dataclasses import replace

import numpy as np
import pytest

from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.choose import contradicts
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

# F of a camera that moves along x, whose lines are the rows, and along y, whose lines are the columns
ALONG_X = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
ALONG_Y = np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]) / np.sqrt(2)


def moved(along_y: int, along_x: int, pixels: float = 40.0) -> Matches:
    """Return matches that agree with ALONG_Y, and others that agree with ALONG_X."""
    points = np.random.default_rng(0).uniform(50, 400, (along_y + along_x, 2)).astype(np.float32)
    shift = np.zeros_like(points)
    shift[:along_y, 1] = pixels
    shift[along_y:, 0] = pixels
    return Matches(points, points + shift, np.ones(len(points), np.float32))


def pair_of(*by_unit: Matches, side: int = 640) -> BatchPair:
    images = (BatchImage(name, name, (side, side)) for name in "AB")
    return BatchPair(*images, by_unit, pair_fundamental=ALONG_Y)


@pytest.mark.parametrize(
    ("by_unit", "speaks_against"),
    [
        pytest.param([moved(100, 40)], True, id="less than half"),
        pytest.param([moved(100, 60)], False, id="more than half"),
        pytest.param([moved(40, 10)], False, id="too few matches"),
        # Cameras of one unit's points have its matches, whatever is right.
        pytest.param([moved(200, 40), moved(20, 30)], False, id="another unit disagrees"),
        pytest.param([moved(40, 0), moved(40, 30)], True, id="both units together"),
        pytest.param([moved(100, 40), moved(3, 4)], True, id="a unit of few matches"),
        pytest.param([moved(100, 40), Matches.empty()], True, id="a unit without matches"),
        pytest.param([], False, id="no unit"),
    ],
)
def test_half_of_the_evidence_speaks_against_the_scene(by_unit, speaks_against):
    assert contradicts(ALONG_X, pair_of(*by_unit)) is speaks_against


def test_the_evidence_of_a_larger_photograph_has_larger_errors():
    """A photograph of eight times the side has keypoints of eight times the error."""
    near = moved(0, 100)
    # 2.5 pixels from the rows: far in a small image, near in a large one
    off = replace(near, points1=near.points1 + np.array([0, 2.5], np.float32))
    by_unit = (Matches.concatenate([moved(100, 0), off]),)
    assert contradicts(ALONG_X, pair_of(*by_unit))
    assert not contradicts(ALONG_X, pair_of(*by_unit, side=8 * 1536))


def test_a_pair_without_its_own_f_does_not_contradict():
    assert not contradicts(ALONG_X, replace(pair_of(moved(100, 40)), pair_fundamental=None))
