"""Support of an F: high for matches of one place, low for any number of wrong matches."""

import numpy as np
import pytest

from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT, support
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, RobustConfig, estimate

QUICK = RobustConfig(max_iterations=2000)


def rectified(right, wrong, seed=0, box=(800, 600)):
    """Matches along rows, whose F is the fallback, and wild ones."""
    rng = np.random.default_rng(seed)
    count = right + wrong
    points0 = rng.uniform(0, box, (count, 2))
    disparity = rng.uniform(0, 50, count)
    points1 = points0 + np.column_stack([disparity, np.zeros(count)])
    points1[right:] = rng.uniform(0, box, (wrong, 2))
    return Matches(points0, points1, np.ones(count))


@pytest.mark.parametrize("wrong", [0, 60, 1000])
def test_right_matches_support_their_f_among_any_number_of_wrong_ones(wrong):
    assert support(FALLBACK_FUNDAMENTAL, rectified(200, wrong)) > MIN_SUPPORT


@pytest.mark.parametrize("wrong", [8, 60, 500, 5000])
def test_wrong_matches_alone_do_not_support_the_best_f_that_is_found(wrong):
    # F is fitted to the wrong matches themselves: any F finds inliers among 5,000.
    matches = rectified(0, wrong)
    F = estimate(matches, QUICK).matrix
    assert support(F, matches) < MIN_SUPPORT


def test_thousands_of_inliers_in_one_spot_are_no_support():
    # All points are within 3 pixels, so shuffled matches agree with F just as often.
    matches = rectified(2000, 0, box=(3, 3))
    rows_apart = np.abs(matches.points0[:, 1] - matches.points1[:, 1])
    assert (rows_apart < 1).all()
    assert support(FALLBACK_FUNDAMENTAL, matches) < MIN_SUPPORT


def test_duplicates_count_once_and_fewer_than_eight_matches_are_no_support():
    matches = rectified(200, 60)
    repeated = Matches.concatenate([matches, matches, matches])
    once = support(FALLBACK_FUNDAMENTAL, matches)
    thrice = support(FALLBACK_FUNDAMENTAL, repeated)
    assert once == thrice
    # Seven matches always have an F that fits them.
    for count in (0, 1, 7):
        assert support(FALLBACK_FUNDAMENTAL, rectified(count, 0)) == 0
