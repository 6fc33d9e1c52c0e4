"""Pairs whose inliers one homography explains are flat, and others are not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.planarity import MIN_PLANE_SHARE, plane_share
from mkpc_kaggle.geometry.robust import RobustConfig, estimate
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.recipe import Recipe, Unit

K = np.array([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]])
R = Rotation.from_rotvec([0.02, 0.2, 0.05]).as_matrix()
T = np.array([-1.5, 0.1, 0.2])
RECIPE = Recipe((Unit(1, "sift", 640),), magsac=RobustConfig(permutations=1))


def seen(depth, noise: float = 0.2, count: int = 150, wrong: int = 0, t=T) -> Matches:
    """Matches of points at these depths, with noise in pixels."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, (count, 2)), np.zeros(count)])
    points[:, 2] = depth(points, rng)
    sides = []
    for in_camera in (points, points @ R.T + t):
        x = in_camera @ K.T
        sides.append(x[:, :2] / x[:, 2:] + rng.normal(0, noise, (count, 2)))
    sides[1][:wrong] = rng.uniform(0, 800, (wrong, 2))
    return Matches(*sides, np.ones(count))


def facade(points, _):
    return 6 + 0.4 * points[:, 0]


def blocks(points, rng):
    return rng.uniform(4, 9, len(points))


SCENES = {
    "facade": (seen(facade), True),
    "facade, with wrong matches": (seen(facade, wrong=50), True),
    "no parallax": (seen(blocks, t=np.zeros(3)), True),
    "blocks": (seen(blocks), False),
    "blocks, with wrong matches": (seen(blocks, wrong=50), False),
    "a facade and something before it": (
        seen(lambda p, r: np.where(r.random(len(p)) < 0.3, 4.0, facade(p, r))),
        False,
    ),
}


@pytest.mark.parametrize(("matches", "is_flat"), SCENES.values(), ids=SCENES)
def test_flat_scenes_are_told_from_others(matches, is_flat):
    pair = PairMatch((UnitResult(RECIPE.units[0], matches),), sizes=(Size(1000, 800),) * 2)
    match = with_estimate(pair, RECIPE)
    assert match.is_flat == is_flat, match.estimate.stats
    assert 0 <= match.estimate.stats.plane <= 1


def test_few_matches_and_equal_points_say_nothing():
    matches = seen(facade)
    F = estimate(matches, RECIPE.magsac).matrix
    assert plane_share(F, matches) >= MIN_PLANE_SHARE
    assert plane_share(F, matches[:10]) == 0
    assert plane_share(F, Matches.empty()) == 0
    same = np.ones((50, 2), np.float32)
    assert plane_share(F, Matches(same, same, np.ones(50))) == 0
    # Duplicates count once.
    assert plane_share(F, Matches.concatenate([matches, matches])) == plane_share(F, matches)
