"""DKM and RoMa: their parts by hand, and the matchers' points and draws."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from light_matchers import dkm_matcher
from pictures import match_one, picture, same

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dense import DenseMatcher, DenseOptions
from mkpc_kaggle.matchers.networks import dense_sampling
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseWarp
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.warp_refiner import identity_map


@pytest.mark.parametrize("floats", [1, 64, 1 << 20])
def test_a_density_is_the_same_in_blocks_of_any_size(monkeypatch, floats):
    monkeypatch.setattr(dense_sampling, "BLOCK_FLOATS", {"cpu": floats})
    points = torch.rand(
        50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    squares = (points[:, None] - points).square().sum(2)
    expected = (squares / (-2 * dense_sampling.BANDWIDTH**2)).clamp(min=-80).exp().sum(1)
    torch.testing.assert_close(dense_sampling.density(points), expected)


def test_matches_without_certainty_are_never_drawn():
    warp = torch.rand(100, 4)
    certainty = torch.ones(100)
    certainty[10:] = 0
    generator = torch.Generator()
    # Fifty are asked for, and ten have a certainty.
    drawn = sample_matches(warp, certainty, 50, 0.05, generator)
    assert sorted(drawn.tolist()) == [*range(10)]
    of_none = sample_matches(warp, certainty * 0, 50, 0.05, generator)
    assert len(of_none) == 0
    of_empty = sample_matches(warp[:0], certainty[:0], 50, 0.05, generator)
    assert len(of_empty) == 0


@pytest.fixture(scope="module")
def matcher() -> DenseMatcher:
    return dkm_matcher(Placement())


# Dense networks resize the content alone: padding would enter the warp as a place to match.
def test_padding_changes_nothing(matcher):
    plain = [
        picture(40, 56),
        picture(50, 36, "another"),
    ]
    padded = [
        picture(40, 56, padding=(13, 26)),
        picture(50, 36, "another", padding=(8, 16)),
    ]
    assert padded[0].pixels.shape == (66, 69, 3)
    assert same(match_one(matcher, *plain), match_one(matcher, *padded))


def identity_warp(height: int, width: int, certainty: float) -> DenseWarp:
    grid = as_grid(identity_map(torch.zeros(height, width)))  # (1, h, w, 2)
    warp = torch.cat([grid, grid], dim=3)
    return DenseWarp(warp, torch.full((1, height, width), certainty))


def test_points_of_either_picture_are_in_its_own_pixels():
    """Both show the same, at another size: places relative to the edges agree."""
    # Two certainties, so that a match shows which of the two warps it comes from.
    warps = (
        identity_warp(40, 60, 0.3),
        identity_warp(80, 30, 0.9),
    )
    network = SimpleNamespace(encode=lambda *_: None, match=lambda *_: warps)
    options = DenseOptions(matches=9999)
    matcher = DenseMatcher(MatcherSpec("given"), network, options, "cpu")
    matches = match_one(matcher, picture(40, 60), picture(80, 30))
    assert len(matches) == 40 * 60 + 80 * 30
    expected = (matches.points0 + 0.5) * (30 / 60, 80 / 40) - 0.5
    np.testing.assert_allclose(matches.points1, expected, atol=1e-4)
    # A warp starts at whole pixels of one picture.
    whole0 = are_whole(matches.points0)
    whole1 = are_whole(matches.points1)
    assert (whole0 | whole1).all()
    np.testing.assert_array_equal(matches.scores == np.float32(0.3), whole0)
    assert set(np.unique(matches.scores)) == {np.float32(0.3), np.float32(0.9)}


def are_whole(points):
    distances = np.abs(points - np.rint(points))
    return distances.max(axis=1) < 1e-4
