"""Two views: the descent to a minimum."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mkpc_kaggle.geometry.two_view import Problem, TwoView


def unit(vector):
    return vector / np.linalg.norm(vector)


def random_view(seed, logs=(0.2, -0.3)):
    rng = np.random.default_rng(seed)
    orthogonal, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    # A reflection becomes a rotation.
    R = orthogonal * np.linalg.det(orthogonal)
    t = unit(rng.normal(size=3))
    return TwoView(R, t, np.array(logs))


def rays(seed, n=60):
    rng = np.random.default_rng(seed)
    both = []
    for focal in (900.0, 800.0):
        pixels = 300 * rng.normal(size=(n, 2))
        both.append(np.column_stack([pixels, np.full(n, focal)]))
    return both


@pytest.mark.parametrize("sigmas", [(0.4, 0.4), (0, 0.4), (0, 0)])
def test_a_fit_never_costs_more_and_leaves_known_focal_lengths_alone(sigmas):
    start = random_view(5, (0, 0))
    deviations = np.array(sigmas)
    problem = Problem(*rays(5), deviations)
    found = problem.fit(start, 50.0)
    assert problem.cost(found, 50.0) < problem.cost(start, 50.0)
    # A sigma of 0 is a known focal length.
    is_known = deviations == 0
    assert_allclose(found.logs[is_known], 0, atol=0)
    assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(found.t) == pytest.approx(1)
