"""Two-view estimates: the truth where it can be found, else a value with its reason, and always the
same bytes.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.synthetic_scene import project
from mkpc_kaggle.geometry import robust
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import (
    FALLBACK_FUNDAMENTAL,
    ModelKind,
    RobustConfig,
    estimate,
)

DEFAULT = RobustConfig()
WIDTH, HEIGHT = 1024, 768
SEEDS = [0, 1, 2]
UNIT = pytest.approx(1, abs=1e-12)


@cache
def cameras(seed):
    rng = np.random.default_rng(seed)
    K0 = np.array(
        [
            [820.0, 0, 500],
            [0, 840, 390],
            [0, 0, 1],
        ]
    )
    K1 = np.array(
        [
            [900.0, 0, 530],
            [0, 880, 370],
            [0, 0, 1],
        ]
    )
    # Turned by up to 15 degrees: both cameras look at the points of `seen`.
    R0, _ = cv2.Rodrigues(rng.uniform(-0.15, 0.15, 3))
    R1, _ = cv2.Rodrigues(rng.uniform(-0.15, 0.15, 3))
    # The baseline is mostly along x, and never zero.
    t = np.array([1.0, *rng.uniform(-0.5, 0.5, 2)])
    return Camera(K0, R0, np.zeros(3)), Camera(K1, R1, t)


def seen(seed, n, *, plane=False):
    """n noiseless matches of random points in general position, or on a plane askew."""
    rng = np.random.default_rng(seed + 100)
    X = rng.uniform((-2, -2, 4), (2, 2, 9), (n, 3))
    if plane:
        x, y, _ = X.T
        X[:, 2] = 6 + 0.2 * x - 0.3 * y
    first, second = cameras(seed)
    return Matches(project(first, X), project(second, X), np.ones(n))


def wild(seed, n):
    """n wrong matches, anywhere in both images."""
    rng = np.random.default_rng(seed + 200)
    points0 = rng.uniform(0, (WIDTH, HEIGHT), (n, 2))
    points1 = rng.uniform(0, (WIDTH, HEIGHT), (n, 2))
    return Matches(points0, points1, np.ones(n))


@cache
def scene(seed, plane=False):
    """300 matches in random order, 40 % of them outliers, and which are true."""
    order = np.random.default_rng(seed).permutation(300)
    inliers = seen(seed, 180, plane=plane)
    matches = Matches.concatenate([inliers, wild(seed, 120)])
    return matches[order], order < 180


def estimated(model, matches, config=DEFAULT, seed=0):
    intrinsics = None
    if model is ModelKind.E:
        intrinsics = tuple(camera.K for camera in cameras(seed))
    return estimate(matches, config, model, intrinsics)


def assert_agrees(result, truth):
    assert result.ok
    assert np.linalg.norm(result.matrix) == UNIT
    found_share = result.inliers[truth].mean()
    assert found_share >= 0.97
    # A wrong match can lie on its epipolar line by chance.
    wrong_share = result.inliers[~truth].mean()
    assert wrong_share <= 0.05


def assert_fallback(result, model, count):
    assert not result.ok
    assert result.failure
    assert result.inliers.shape == (count,)
    assert result.inlier_count == 0
    expected = FALLBACK_FUNDAMENTAL / np.sqrt(2)
    if model is ModelKind.H:
        expected = np.eye(3) / np.sqrt(3)
    assert_allclose(result.matrix, expected, atol=1e-15)


def as_bytes(result):
    return result.matrix.tobytes(), result.inliers.tobytes(), result.failure


@pytest.mark.parametrize("seed", SEEDS)
def test_the_fundamental_matrix_is_found_among_outliers(seed):
    matches, truth = scene(seed)
    result = estimate(matches, DEFAULT)
    assert_agrees(result, truth)
    assert np.linalg.svd(result.matrix, compute_uv=False)[2] < 1e-9
    # Another scene's match
    assert robust.sampson_distances(result.matrix, seen(seed + 10, 1)).max() > 1
    # Points that the estimate has not seen: an F that only fits its own matches fails here.
    fresh = seen(seed, 500)[180:]
    distances = robust.sampson_distances(result.matrix, fresh)
    assert np.median(distances) < 0.07
    assert distances.max() < 0.35


def test_the_essential_matrix_and_the_homography_of_a_plane_are_found_among_outliers():
    result = estimated(ModelKind.E, scene(0)[0])
    first, second = cameras(0)
    E = second.K.T @ fundamental_of_cameras(first, second) @ first.K
    E /= np.linalg.norm(E)
    # The sign of E is free.
    difference = np.linalg.norm(result.matrix - E)
    with_other_sign = np.linalg.norm(result.matrix + E)
    assert min(difference, with_other_sign) < 1e-3
    result = estimated(ModelKind.H, scene(0, plane=True)[0])
    fresh = seen(0, 500, plane=True)[180:]
    moved = cv2.perspectiveTransform(fresh.points0[:, None], result.matrix)[:, 0]
    assert np.hypot(*(moved - fresh.points1).T).max() < 0.05


@pytest.mark.parametrize("model", ModelKind)
def test_a_model_needs_one_match_more_than_its_minimum_else_the_fallback_is_given(model):
    # One more than the minimal sample of each solver (7, 5, 4): with a minimal sample alone,
    # nothing would contradict a wrong match.
    fewest = {ModelKind.F: 8, ModelKind.E: 6, ModelKind.H: 5}[model]
    few = estimated(model, seen(0, fewest - 1))
    assert_fallback(few, model, fewest - 1)
    assert f"too few distinct matches for {model}: {fewest - 1}" in few.failure
    few.matrix[:] = 7  # each fallback has its own matrix
    assert_fallback(estimated(model, Matches.empty()), model, 0)
    assert estimated(model, seen(0, fewest, plane=model is ModelKind.H)).ok


@pytest.mark.parametrize("model", ModelKind)
def test_repeated_matches_do_not_change_the_model_and_non_finite_ones_are_never_inliers(
    model,
):
    matches, truth = scene(1, plane=model is ModelKind.H)
    clean = estimated(model, matches, seed=1)
    assert_agrees(clean, truth)
    # Units of several sizes find the same points: repetitions must not outvote other matches.
    again = np.random.default_rng(4).integers(0, 300, 900)
    ones = np.ones(50)
    fives = np.full((50, 2), 5)
    nan = Matches(np.full((50, 2), np.nan), fives, ones)
    infinite = Matches(fives, np.full((50, 2), np.inf), ones)
    together = Matches.concatenate([nan, matches, infinite, matches[again]])
    more = estimated(model, together, seed=1)
    assert_array_equal(more.matrix, clean.matrix)
    none = np.zeros(50, bool)
    expected = np.concatenate([none, clean.inliers, none, clean.inliers[again]])
    assert_array_equal(more.inliers, expected)


@pytest.mark.parametrize("model", ModelKind)
def test_the_same_input_gives_the_same_bytes_after_other_calls_and_beside_other_threads(
    model,
):
    plane = model is ModelKind.H
    config = RobustConfig(max_iterations=2000)
    inputs = [scene(seed, plane)[0] for seed in SEEDS] * 2

    def result_of(matches):
        return as_bytes(estimated(model, matches, config))

    alone = [result_of(matches) for matches in inputs]
    assert alone[:3] == alone[3:]
    assert len(set(alone)) == 3
    # OpenCV has one generator of random numbers for each process.
    for rng_seed in (0, 12345):
        cv2.setRNGSeed(rng_seed)
        again = [result_of(matches) for matches in inputs[:3]]
        assert again == alone[:3]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(result_of, inputs))
    assert together == alone


ANY_FLOAT = st.floats(width=32)
# Squares of 1e20 overflow float32, and squares of 1e-20 vanish.
EXTREMES = np.array([0, 1, -1, 2, 100, 1e-20, 1e10, 1e18, 1e20, 3e38], np.float32)
CORNERS = st.sampled_from(EXTREMES.tolist())
# Few values, so that points coincide.
PIXELS = st.integers(0, 5).map(float)


@given(
    data=st.data(),
    n=st.integers(0, 24),
    model=st.sampled_from(ModelKind),
)
@settings(max_examples=150, deadline=None)
def test_any_points_give_a_finite_matrix_of_norm_1_and_a_mask(data, n, model):
    elements = data.draw(st.sampled_from([ANY_FLOAT, CORNERS, PIXELS]))
    rows = data.draw(arrays(np.float32, (n, 4), elements=elements))
    if data.draw(st.booleans()):
        with np.errstate(all="ignore"):  # infinite is fine, too
            rows[:, 1] = rows[:, 0]
            rows[:, 3] = 2 * rows[:, 2]  # collinear
    matches = Matches(rows[:, :2], rows[:, 2:], np.ones(n))
    result = estimated(model, matches, RobustConfig(max_iterations=100))
    assert result.matrix.shape == (3, 3)
    assert np.isfinite(result.matrix).all()
    assert np.linalg.norm(result.matrix) == UNIT
    assert result.inliers.shape == (n,)
    assert result.ok == result.inliers.any()
    is_finite = np.isfinite(rows).all(axis=1)
    assert not result.inliers[~is_finite].any()


def test_a_matrix_of_rank_3_is_no_fundamental_matrix(monkeypatch):
    """OpenCV returns one for some sets of wrong matches. It would be a wrong answer of its worker."""
    matches = seen(0, 60)
    mask = np.ones((60, 1), np.uint8)
    monkeypatch.setattr(robust.cv2, "findFundamentalMat", lambda *_, **__: (np.eye(3), mask))
    found = estimate(matches, DEFAULT)
    assert found.failure.startswith("no F fits 60 distinct matches")
    assert_array_equal(
        found.matrix, FALLBACK_FUNDAMENTAL / np.linalg.norm(FALLBACK_FUNDAMENTAL)
    )
