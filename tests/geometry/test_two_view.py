"""Two views: F and its derivatives, the Sampson distance, and the descent to a minimum."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.two_view import Problem, TwoView, sampson


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


# Three of rotation, two of the direction of translation, two focal lengths.
@pytest.mark.parametrize("k", range(7))
def test_the_gradient_of_the_cost_is_that_of_finite_differences(k):
    view = random_view(1)
    problem = Problem(*rays(1), np.array([0.4, 0.2]), weight=2.0)
    size = 1e-6
    step = size * np.eye(7)[k]
    forth = problem.cost(view.moved(step), 30.0)
    back = problem.cost(view.moved(-step), 30.0)
    slope = (forth - back) / (2 * size)
    gradient, curvature = problem._derivatives(view, 30.0)
    assert gradient[k] == pytest.approx(slope, abs=1e-5)
    assert_allclose(curvature, curvature.T)


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


def rays_of(points, view):
    """Rays (N, 3) of points (N, 3) in camera 0's world, for both images of a view with focal
    lengths of 1000.
    """
    focal = 1000.0
    in_cameras = (points, points @ view.R.T + view.t)
    rays = []
    for x, log in zip(in_cameras, view.logs, strict=True):
        pixels = focal * np.exp(log) * x[:, :2] / x[:, 2:]
        depth = np.full(len(x), focal)
        rays.append(np.column_stack([pixels, depth]))
    return rays


def test_depth_signs_are_1_in_front_of_both_cameras_minus_1_behind_both_and_0_between():
    turn = Rotation.from_rotvec([0, 0.2, 0]).as_matrix()
    view = TwoView(turn, unit([1, 0.1, 1]), np.array([0.2, -0.3]))
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 3), (1, 1, 6), (50, 3))
    in_front = rays_of(points, view)
    assert_allclose(sampson(view.fundamental, *in_front), 0, atol=1e-6)
    assert (view.depth_signs(*in_front, 1.0) == 1).all()
    # Mirrored at the middle of the two centres
    behind = rays_of(-points - 2 * view.R.T @ view.t, view)
    assert (view.depth_signs(*behind, 1.0) == -1).all()
    # Behind camera 0, in front of camera 1
    between = rays_of(np.array([[0.01, 0.02, -0.3]]), view)
    assert (view.depth_signs(*between, 1.0) == 0).all()
    # The twisted pair has the same F, so only the depths differ.
    twisted = view.twisted
    assert_allclose(twisted.fundamental, -view.fundamental, atol=1e-12)
    assert not (twisted.depth_signs(*in_front, 1.0) > 0).any()
