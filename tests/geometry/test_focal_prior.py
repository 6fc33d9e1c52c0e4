"""F under a prior on focal lengths: nearer to the truth than MAGSAC alone, and always a value with
its reason.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.synthetic_scene import project
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import pose_error
from mkpc_kaggle.geometry.robust import ModelKind, RobustConfig, estimate, sampson_distances

SIZE = Size(1024, 768)
CENTRE = np.array([511.5, 383.5])
MAGSAC = RobustConfig(permutations=1, max_iterations=2000)
CONFIG = FocalConfig()
WEAK = FocalPrior.of_image(SIZE), FocalPrior.of_image(SIZE)


def camera(focal, turn=0.0, t=(0, 0, 0), centre=CENTRE):
    c, s = np.cos(turn), np.sin(turn)
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    return Camera(K, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array(t, float))


CAMERAS = camera(900.0), camera(1300.0, 0.15, (-1.0, 0.1, 0.2))


def seen(cameras, n=200, noise=0.0, outliers=0, seed=0, depth=(4, 9)):
    """n matches of random points, then wild ones."""
    rng = np.random.default_rng(seed)
    X = rng.uniform((-1.5, -1.2, depth[0]), (1.5, 1.2, depth[1]), (n, 3))
    points = [project(view, X) + rng.normal(scale=noise, size=(n, 2)) for view in cameras]
    wild = [rng.uniform(0, SIZE, (outliers, 2)) for _ in range(2)]
    return Matches(
        *(np.vstack(both) for both in zip(points, wild, strict=True)), np.ones(n + outliers)
    )


def with_prior(matches, priors=WEAK, magsac=MAGSAC, config=CONFIG, model=ModelKind.F):
    return estimate_with_prior(matches, priors, magsac, config, model)


def test_focal_lengths_and_pose_are_found_among_outliers():
    result = with_prior(seen(CAMERAS, 400, 0.05, 150))
    assert result.ok
    error = pose_error(result.matrix, *CAMERAS, 1.0)
    assert error.rotation < 1
    assert error.translation_angle < 2
    assert result.inliers[:400].mean() > 0.95
    assert result.inliers[400:].mean() < 0.05
    plain = estimate(seen(CAMERAS, 400, 0.05, 150), MAGSAC).matrix
    assert_allclose(result.magsac, np.sign(np.sum(result.magsac * plain)) * plain, atol=1e-12)


def test_few_noisy_matches_have_a_better_pose_the_more_is_known_of_the_focal_lengths():
    exif = FocalPrior.of_image(SIZE, 700.0)
    assert exif.focal == 700 != WEAK[0].focal and exif.sigma < WEAK[0].sigma
    sure = FocalPrior.of_focal(900, 0.01, SIZE), FocalPrior.of_focal(1300, 0.01, SIZE)
    alone, weakly, surely = [], [], []
    for seed in range(6):
        matches = seen(CAMERAS, 30, 0.2, 20, seed, depth=(5, 6))
        known = with_prior(matches, sure)
        for result, errors in (
            (estimate(matches, MAGSAC), alone),
            (with_prior(matches), weakly),
            (known, surely),
        ):
            errors.append(pose_error(result.matrix, *CAMERAS, 1.0).angle)
    assert np.median(weakly) < 0.7 * np.median(alone)
    assert np.median(surely) < 0.7 * np.median(weakly)


def test_known_cameras_of_two_focal_lengths_and_any_centre_give_their_essential_matrix():
    K0 = np.array([[820.0, 0, 400], [0, 860, 390], [0, 0, 1]])
    first = Camera(K0, np.eye(3), np.zeros(3))
    second = CAMERAS[1]
    matches = seen((first, second), 100, 0.2, 40)
    result = with_prior(matches, (FocalPrior(K0, 0), FocalPrior(second.K, 0)), model=ModelKind.E)
    assert result.ok
    assert_allclose(
        np.linalg.svd(result.matrix, compute_uv=False), np.array([1, 1, 0]) / np.sqrt(2), atol=1e-9
    )
    assert pose_error(result.matrix, first.calibrated, second.calibrated, 1.0).angle < 2
    assert result.inlier_count > 0
    assert result.magsac is None


def test_a_principal_point_far_off_leaves_magsac_its_matrix():
    cropped = (
        camera(700.0, centre=(-900, 1500)),
        camera(800.0, 0.3, (-2.0, 0.3, 0.5), centre=(2500, -800)),
    )
    rng = np.random.default_rng(0)
    X = rng.uniform((-4, -4, 4), (4, 4, 9), (400, 3))
    matches = Matches(*(project(view, X) for view in cropped), np.ones(400))
    result = with_prior(matches)
    assert result.ok
    assert_array_equal(result.matrix, result.magsac)
    assert result.stats.focals == (0, 0)
    assert result.stats.cost == result.stats.magsac_cost
    assert sampson_distances(result.matrix, matches).max() < 0.1


def degenerate():
    rng, along = np.random.default_rng(0), np.linspace(0, 700, 40)
    X = np.column_stack([rng.uniform(-1, 1, (80, 2)), np.full(80, 5.0)])
    return {
        "a pure rotation": seen((camera(1100), camera(1100, 0.1)), 80, 0.1),
        "one plane": Matches(*(project(view, X) for view in CAMERAS), np.ones(80)),
        "a line": Matches(
            np.column_stack([along, along]), np.column_stack([along, 2 * along]), np.ones(40)
        ),
        "six": seen(CAMERAS, 6),
        "five": seen(CAMERAS, 5),
        "none": Matches.empty(),
        "the same points": Matches(*2 * [rng.uniform(0, 700, (50, 2))], np.ones(50)),
        "far points": Matches(*(rng.normal(size=(40, 2)) * 1e18 for _ in range(2)), np.ones(40)),
    }


@pytest.mark.parametrize("name", degenerate())
def test_degenerate_matches_end_in_a_value(name):
    matches = degenerate()[name]
    result = with_prior(matches)
    assert np.isfinite(result.matrix).all()
    assert np.linalg.norm(result.matrix) == pytest.approx(1)
    assert result.inliers.shape == (len(matches),)
    assert result.ok or result.inlier_count == 0
    assert ("too few distinct matches" in result.failure) == (name in ("five", "none"))
    assert name != "six" or (result.ok and result.magsac is None)


def test_magsac_wins_over_focal_lengths_that_are_too_implausible():
    for sigma, has_focals in ((0.4, True), (0.03, False)):
        priors = (FocalPrior.of_focal(WEAK[0].focal, sigma, SIZE),) * 2
        assert any(with_prior(seen(CAMERAS, 400, 0.05), priors).stats.focals) == has_focals


def test_matches_of_points_behind_the_cameras_cost_as_outliers():
    X = np.random.default_rng(1).uniform((-1.5, -1.2, -9), (1.5, 1.2, -4), (60, 3))
    before, behind = (
        seen(CAMERAS, 200, 0.05),
        Matches(*(project(view, X) for view in CAMERAS), np.ones(60)),
    )
    costs = [
        with_prior(matches).stats.cost
        for matches in (before, Matches.concatenate([before, behind]))
    ]
    assert costs[1] - costs[0] == pytest.approx(60 / 2, rel=0.1)
