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
from mkpc_kaggle.geometry.metrics import pose_error
from mkpc_kaggle.geometry.robust import (
    FALLBACK_FUNDAMENTAL,
    Method,
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
    K0 = np.array([[820.0, 0, 500], [0, 840, 390], [0, 0, 1]])
    K1 = np.array([[900.0, 0, 530], [0, 880, 370], [0, 0, 1]])
    R0, R1 = (cv2.Rodrigues(rng.uniform(-0.15, 0.15, 3))[0] for _ in range(2))
    t = np.array([1.0, rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5)])
    return Camera(K0, R0, np.zeros(3)), Camera(K1, R1, t)


def seen(seed, n, *, plane=False):
    """n noiseless matches of random points in general position, or on a plane askew."""
    X = np.random.default_rng(seed + 100).uniform((-2, -2, 4), (2, 2, 9), (n, 3))
    if plane:
        X[:, 2] = 6 + 0.2 * X[:, 0] - 0.3 * X[:, 1]
    first, second = cameras(seed)
    return Matches(project(first, X), project(second, X), np.ones(n))


def wild(seed, n):
    rng = np.random.default_rng(seed + 200)
    return Matches(*(rng.uniform(0, (WIDTH, HEIGHT), (n, 2)) for _ in range(2)), np.ones(n))


@cache
def scene(seed, plane=False):
    """300 matches in random order, 40 % of them outliers, and which are true."""
    order = np.random.default_rng(seed).permutation(300)
    matches = Matches.concatenate([seen(seed, 180, plane=plane), wild(seed, 120)])
    return matches[order], order < 180


def estimated(model, matches, config=DEFAULT, seed=0):
    intrinsics = tuple(camera.K for camera in cameras(seed)) if model is ModelKind.E else None
    return estimate(matches, config, model, intrinsics)


def assert_agrees(result, truth):
    assert result.ok
    assert np.linalg.norm(result.matrix) == UNIT
    assert (result.inliers & truth).sum() >= 0.97 * truth.sum()
    assert (result.inliers & ~truth).sum() <= 0.05 * (~truth).sum()


def assert_fallback(result, model, count):
    assert not result.ok
    assert result.failure
    assert result.inliers.shape == (count,)
    assert result.inlier_count == 0
    expected = np.eye(3) / np.sqrt(3) if model is ModelKind.H else FALLBACK_FUNDAMENTAL / np.sqrt(2)
    assert_allclose(result.matrix, expected, atol=1e-15)


def as_bytes(result):
    return result.matrix.tobytes(), result.inliers.tobytes(), result.failure


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("method", Method)
def test_the_fundamental_matrix_is_found_among_outliers(seed, method):
    matches, truth = scene(seed)
    result = estimate(matches, RobustConfig(method=method))
    assert_agrees(result, truth)
    assert np.linalg.svd(result.matrix, compute_uv=False)[2] < 1e-9
    # Another scene's match
    assert robust.sampson_distances(result.matrix, seen(seed + 10, 1)).max() > 1
    fresh = seen(seed, 500)[180:]
    distances = robust.sampson_distances(result.matrix, fresh)
    # MAGSAC++ is a weighted mean of near samples: RANSAC here is below 0.001
    assert np.median(distances) < 0.07
    assert distances.max() < 0.35


def test_the_essential_matrix_and_the_homography_of_a_plane_are_found_among_outliers():
    result = estimated(ModelKind.E, scene(0)[0])
    first, second = cameras(0)
    E = second.K.T @ fundamental_of_cameras(first, second) @ first.K
    E /= np.linalg.norm(E)
    assert min(np.linalg.norm(result.matrix - E), np.linalg.norm(result.matrix + E)) < 1e-3
    result = estimated(ModelKind.H, scene(0, plane=True)[0])
    fresh = seen(0, 500, plane=True)[180:]
    moved = cv2.perspectiveTransform(fresh.points0[:, None], result.matrix)[:, 0]
    assert np.hypot(*(moved - fresh.points1).T).max() < 0.05


def test_magsac_finds_the_pose_of_noisy_matches_at_a_threshold_of_a_pixel():
    errors = []
    for seed in range(12):
        matches, _ = scene(seed)
        noise = np.random.default_rng(seed).normal(0, 0.5, (2, *matches.points0.shape))
        noisy = Matches(matches.points0 + noise[0], matches.points1 + noise[1], matches.scores)
        result = estimated(ModelKind.E, noisy, RobustConfig(threshold=1.0, permutations=1), seed)
        errors.append(
            pose_error(result.matrix, *(camera.calibrated for camera in cameras(seed)), 1.0).angle
        )
    # Degrees; 0.9 in units of the focal length, where the score has no scale
    assert np.median(errors) < 0.4


def test_sampson_distance_is_in_pixels_and_the_same_in_either_order():
    matches = Matches(np.array([(10, 20), (30, 40)]), np.array([(500, 20), (7, 43)]), np.ones(2))
    assert_allclose(robust.sampson_distances(FALLBACK_FUNDAMENTAL, matches), [0, 3 / np.sqrt(2)])
    # The second image is half as high: y1 = y0 / 2
    twice = FALLBACK_FUNDAMENTAL @ np.diag([1, 0.5, 1])
    matches = Matches(np.array([(10, 20)]), np.array([(500, 13)]), np.ones(1))
    distance = 3 / np.sqrt(1 + 0.5**2)
    assert_allclose(robust.sampson_distances(twice, matches), [distance])
    swapped = Matches(matches.points1, matches.points0, np.ones(1))
    assert_allclose(robust.sampson_distances(1e-6 * twice.T, swapped), [distance])
    assert robust.sampson_distances(twice, Matches.empty()).shape == (0,)


@pytest.mark.parametrize("model", ModelKind)
def test_fewer_matches_than_a_model_needs_give_the_fallback_and_so_many_give_the_model(model):
    fewest = {ModelKind.F: 8, ModelKind.E: 6, ModelKind.H: 5}[model]
    few = estimated(model, seen(0, fewest - 1))
    assert_fallback(few, model, fewest - 1)
    assert f"too few distinct matches for {model}: {fewest - 1}" in few.failure
    few.matrix[:] = 7  # each fallback has a matrix of its own
    assert_fallback(estimated(model, Matches.empty()), model, 0)
    assert estimated(model, seen(0, fewest, plane=model is ModelKind.H)).ok


@pytest.mark.parametrize("model", ModelKind)
def test_repetitions_are_inliers_like_the_first_and_what_is_not_finite_is_set_aside(model):
    matches, truth = scene(1, plane=model is ModelKind.H)
    clean = estimated(model, matches, seed=1)
    assert_agrees(clean, truth)
    again = np.random.default_rng(4).integers(0, 300, 900)
    bad = [
        Matches(np.full((50, 2), a), np.full((50, 2), b), np.ones(50))
        for a, b in [(np.nan, 5), (5, np.inf)]
    ]
    more = estimated(model, Matches.concatenate([bad[0], matches, bad[1], matches[again]]), seed=1)
    assert_array_equal(more.matrix, clean.matrix)
    none = np.zeros(50, bool)
    assert_array_equal(
        more.inliers, np.concatenate([none, clean.inliers, none, clean.inliers[again]])
    )


@pytest.mark.parametrize("method", Method)
@pytest.mark.parametrize("model", ModelKind)
def test_the_same_input_gives_the_same_bytes_whatever_else_goes_on(model, method):
    plane, config = model is ModelKind.H, RobustConfig(method=method, max_iterations=2000)
    inputs = [scene(seed, plane)[0] for seed in SEEDS] * 2
    alone = [as_bytes(estimated(model, matches, config)) for matches in inputs]
    assert alone[:3] == alone[3:]
    assert len(set(alone)) == 3
    for rng_seed in (0, 12345):
        cv2.setRNGSeed(rng_seed)
        assert [as_bytes(estimated(model, matches, config)) for matches in inputs[:3]] == alone[:3]
    with ThreadPoolExecutor(4) as threads:
        together = list(
            threads.map(lambda matches: as_bytes(estimated(model, matches, config)), inputs)
        )
    assert together == alone


ANY_FLOAT = st.floats(width=32)
CORNERS = st.sampled_from(
    np.array([0, 1, -1, 2, 100, 1e-20, 1e10, 1e18, 1e20, 3e38], np.float32).tolist()
)
PIXELS = st.integers(0, 5).map(float)


@given(
    data=st.data(),
    n=st.integers(0, 24),
    model=st.sampled_from(ModelKind),
    method=st.sampled_from(Method),
)
@settings(max_examples=150, deadline=None)
def test_whatever_the_points_are_the_answer_is_an_estimate(data, n, model, method):
    elements = data.draw(st.sampled_from([ANY_FLOAT, CORNERS, PIXELS]))
    rows = data.draw(arrays(np.float32, (n, 4), elements=elements))
    if data.draw(st.booleans()):
        with np.errstate(all="ignore"):  # infinite is fine, too
            rows[:, 1], rows[:, 3] = rows[:, 0], 2 * rows[:, 2]  # collinear
    matches = Matches(rows[:, :2], rows[:, 2:], np.ones(n))
    result = estimated(model, matches, RobustConfig(method=method, max_iterations=100))
    assert result.matrix.shape == (3, 3)
    assert np.isfinite(result.matrix).all()
    assert np.linalg.norm(result.matrix) == UNIT
    assert result.inliers.shape == (n,)
    assert result.ok == result.inliers.any()
    assert not result.inliers[~np.isfinite(rows).all(axis=1)].any()


@pytest.mark.parametrize("refused", [1, 3])
def test_a_refusal_by_opencv_costs_its_permutation_and_is_the_reason_where_all_are_refused(
    refused, monkeypatch
):
    calls = []

    def find(*points, **settings):
        calls.append(points)
        if len(calls) <= refused:
            error = cv2.error("no")
            error.err = "sample_size <= points_size_"
            raise error
        return cv2.findFundamentalMat(*points, **settings)

    monkeypatch.setitem(
        robust._SOLVERS, ModelKind.F, robust._SOLVERS[ModelKind.F]._replace(find=find)
    )
    found = estimate(seen(0, 60), RobustConfig(permutations=3))
    assert len(calls) == 3
    assert found.failure == (
        "" if refused == 1 else "OpenCV refused the points: sample_size <= points_size_"
    )
