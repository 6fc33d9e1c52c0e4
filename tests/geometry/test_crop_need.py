"""The rule that says where stage 2 pays, and the scale between two images by their matches."""

import numpy as np
import pytest

from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import (
    CriticalRegion,
    MkpcConfig,
    RegionReason,
    When,
)
from mkpc_kaggle.geometry.crop_need import crop_need, scale_between
from mkpc_kaggle.geometry.matches import Matches

SIZE = Size(1000, 800)
SMALL = CriticalRegion(Box(100, 100, 500, 400), RegionReason.CROPPED)
WHOLE = CriticalRegion(Box.whole(SIZE), RegionReason.TOO_SCATTERED)
BY_SCALE = MkpcConfig(when=When.SCALE, min_scale=1.75, min_detail=2.0)
STORED = (1.0, 1.0)  # views at the size of the file


def zoomed(factor, count=200, wrong=0, noise=0.5):
    """Matches of an image and of ``factor`` times its middle; ``wrong`` of them anywhere."""
    rng = np.random.default_rng(count)
    points0 = rng.uniform((400, 320), (600, 480), (count, 2))
    turn = np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    points1 = (
        (points0 - (500, 400)) * factor @ turn + (500, 400) + rng.normal(0, noise, (count, 2))
    )
    points1[:wrong] = rng.uniform((0, 0), SIZE, (wrong, 2))
    return Matches(points0, points1, np.ones(count))


@pytest.mark.parametrize(("factor", "wrong"), [(1.0, 0), (1.3, 0), (3.0, 20)])
def test_the_scale_is_that_of_the_images_in_either_order(factor, wrong):
    matches = zoomed(factor, wrong=wrong)
    other_way = Matches(matches.points1, matches.points0, matches.scores)
    assert scale_between(matches, (SIZE, SIZE)) == pytest.approx(
        factor, rel=0.1 if wrong else 0.03
    )
    assert scale_between(other_way, (SIZE, SIZE)) == pytest.approx(
        factor, rel=0.1 if wrong else 0.05
    )


def test_the_scale_is_relative_to_the_images_since_views_have_one_size():
    # A photograph of twice the pixels shows the same.
    matches = zoomed(2.0)
    assert scale_between(matches, (SIZE, Size(2000, 1600))) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    "matches",
    [Matches.empty(), zoomed(3.0, count=7), zoomed(3.0, wrong=200), zoomed(0.0, noise=0.0)],
    ids=["none", "seven", "all wrong", "one point"],
)
def test_matches_that_say_nothing_have_scale_one(matches):
    assert scale_between(matches, (SIZE, SIZE)) == 1.0


@pytest.mark.parametrize(
    ("regions", "scale", "whole", "crop", "is_needed"),
    [
        ((SMALL, SMALL), 1.7, STORED, STORED, False),
        ((SMALL, SMALL), 1.8, STORED, STORED, True),
        # The larger image has too few points in clusters; the other one is cropped.
        ((SMALL, WHOLE), 3.0, STORED, STORED, True),
        ((WHOLE, WHOLE), 3.0, STORED, STORED, False),
        # A photograph of 4,000 pixels in a view of 1,000; its crop is shown as stored.
        ((SMALL, SMALL), 1.0, (0.25, 1.0), (0.6, 1.0), True),
        ((SMALL, SMALL), 1.0, (0.25, 1.0), (0.4, 1.0), False),
        # An enlarged crop has no more detail.
        ((SMALL, SMALL), 1.0, STORED, (3.0, 3.0), False),
    ],
)
def test_a_crop_is_needed_where_scales_differ_or_detail_comes_back(
    regions, scale, whole, crop, is_needed
):
    assert crop_need(regions, scale, whole, crop, BY_SCALE).is_needed is is_needed
    assert crop_need(regions, scale, whole, crop, MkpcConfig()).is_needed, (
        "the paper's: always"
    )
