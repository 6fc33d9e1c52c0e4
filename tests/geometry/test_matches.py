"""Matches: a value that keeps its order and drops what is not on the images."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.matches import Matches

NAN = np.nan
INF = np.inf


def scored(scores):
    """The i-th match lies at (i, i), so its point identifies it."""
    numbers = np.arange(len(scores))
    at = np.column_stack([numbers, numbers])
    return Matches(at, at, np.asarray(scores))


def places(matches):
    assert_array_equal(matches.points0, matches.points1)
    return matches.points0[:, 0].astype(int).tolist()


@pytest.mark.parametrize(
    ("shape0", "shape1", "shape_scores"),
    [
        ((2, 2), (3, 2), (3,)),
        ((3, 2), (3, 2), (3, 1)),  # NumPy would broadcast these scores to (3, 3)
    ],
)
def test_shapes_that_disagree_are_an_error(shape0, shape1, shape_scores):
    with pytest.raises(ValueError, match=r"has shape .*; expected shape \(N, ?2?\), N = 3"):
        Matches(np.zeros(shape0), np.zeros(shape1), np.zeros(shape_scores))


def test_empty_is_legal_everywhere():
    empty = Matches.empty()
    view = View.fit(Box.whole(Size(40, 30)), long_side=64)
    results = [
        empty,
        Matches([], [], []),
        Matches.concatenate([]),
        Matches.concatenate([empty, empty]),
        empty.best(0),
        scored([1, 2]).best(0),
        empty.to_image(view, view),
        empty[:],
    ]
    for result in results:
        assert result.points0.shape == result.points1.shape == (0, 2)
        assert result.scores.shape == (0,)


def test_concatenation_keeps_every_match_in_order_and_duplicates():
    parts = [scored([1, 1]), Matches.empty(), scored([1]), scored([1, 1])]
    # An iterator: it can be read only once.
    together = Matches.concatenate(iter(parts))
    assert places(together) == [0, 1, 0, 0, 1]


@given(scores=st.lists(st.integers(0, 5), max_size=40), most=st.integers(0, 45))
@settings(max_examples=100, deadline=None)
def test_the_best_matches_are_the_first_of_a_stable_sort_in_their_own_order(scores, most):
    # MAGSAC's result depends on the order, so the kept matches stay in theirs.
    by_score = sorted(range(len(scores)), key=lambda i: -scores[i])
    best = scored(scores).best(most)
    assert places(best) == sorted(by_score[:most])
    # NaN sorts last: a score that is unknown beats none.
    best = scored([NAN, 0.2, NAN, 0.1]).best(2)
    assert places(best) == [1, 3]


def test_to_image_drops_points_on_padding_outside_or_not_finite_and_maps_the_rest():
    view0 = View(Box(10, 20, 50, 40), Size(80, 40), Size(96, 64))
    view1 = View(Box(0, 0, 60, 60), Size(30, 30), Size(32, 32))
    rows = [
        ((0.5, 0.5), (0, 0), 0.9),  # kept
        ((85, 10), (5, 5), 1),  # on the padding of view 0
        ((10, 50), (5, 5), 1),
        ((10, 10), (31, 5), 1),  # on the padding of view 1
        ((79.25, 39.25), (29, 29), 0.1),  # kept
        ((-0.75, 3), (5, 5), 1),  # outside
        ((NAN, 3), (5, 5), 1),
        ((3, 3), (5, INF), 1),
        ((3, 3), (5, 5), NAN),
        ((3, 3), (5, 5), INF),
        ((40, 20), (14, 10), -3),  # kept: a low score is a score
    ]
    points0, points1, scores = zip(*rows, strict=True)
    found = Matches(np.float32(points0), np.float32(points1), np.float32(scores))
    out = found.to_image(view0, view1)
    assert_allclose(out.points0, [(10, 20), (49.375, 39.375), (29.75, 29.75)], atol=1e-5)
    assert_allclose(out.points1, [(0.5, 0.5), (58.5, 58.5), (28.5, 20.5)], atol=1e-5)
    assert_array_equal(out.scores, np.array([0.9, 0.1, -3], np.float32))
    assert out.points0.dtype == out.points1.dtype == np.float32
