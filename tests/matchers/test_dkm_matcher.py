"""DKM as a matcher, from a checkpoint in the public format, with stand-in weights."""

import numpy as np
import pytest
import torch
from checkpoints import FILES, store_of
from pictures import match_one, picture, same

from mkpc_kaggle.matchers.adapters import dkm
from mkpc_kaggle.matchers.adapters.dkm import DkmMatcher
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.dense import DenseEncoding, DenseOptions
from mkpc_kaggle.matchers.networks.dense_warp import DenseFeatures, DenseWarp
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.warp_refiner import identity_map


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> DKM:
    store = store_of(tmp_path_factory.mktemp("weights"), [file for file in FILES if file.matcher == "dkm"])
    return dkm.load(store, DenseOptions(), Placement())._network


@pytest.fixture
def matcher(network: DKM) -> DkmMatcher:
    return DkmMatcher(network, DenseOptions(matches=300), "cpu")


def test_which_matches_are_drawn_depends_on_both_pictures(matcher: DkmMatcher) -> None:
    """Features of one pair, digests of others: the same warp is drawn from in other ways."""
    first, second = matcher.encode([picture(40, 56, f"{seed}") for seed in (0, 1)])
    drawn = [
        matcher.match([DenseEncoding(first.features, first.content, checksum0)], [second])[0]
        for checksum0 in (first.checksum, first.checksum, 7)
    ]
    drawn += matcher.match([first], [DenseEncoding(second.features, second.content, 7)])
    assert [same(drawn[0], other) for other in drawn] == [True, True, False, False]


def test_padding_changes_nothing(matcher: DkmMatcher) -> None:
    plain = [picture(40, 56), picture(50, 36, "another")]
    padded = [picture(40, 56, padding=(13, 26)), picture(50, 36, "another", padding=(8, 16))]
    assert padded[0].pixels.shape == (66, 69, 3)
    assert same(match_one(matcher, *plain), match_one(matcher, *padded))


class Given:
    """A network that answers with these warps."""

    def __init__(self, *warps: DenseWarp) -> None:
        self.warps = warps

    def to(self, device: str) -> "Given":
        return self

    def encode(self, image: torch.Tensor, fine: torch.Tensor | None = None) -> DenseFeatures:
        return None

    def match(self, first: DenseFeatures, second: DenseFeatures) -> tuple[DenseWarp, ...]:
        return self.warps


def identity_warp(height: int, width: int, certainty: float) -> DenseWarp:
    grid = as_grid(identity_map(torch.zeros(height, width)))  # (1, h, w, 2)
    return DenseWarp(torch.cat([grid, grid], dim=3), torch.full((1, height, width), certainty))


def test_points_of_either_picture_are_in_its_own_pixels() -> None:
    """Both show the same, at another size: places relative to the edges agree."""
    warps = identity_warp(40, 60, 0.3), identity_warp(80, 30, 0.9)
    matcher = DkmMatcher(Given(*warps), DenseOptions(matches=9999), "cpu")
    matches = match_one(matcher, picture(40, 60), picture(80, 30))
    assert len(matches) == 40 * 60 + 80 * 30
    expected = (matches.points0 + 0.5) * (30 / 60, 80 / 40) - 0.5
    np.testing.assert_allclose(matches.points1, expected, atol=1e-4)
    whole0 = np.abs(matches.points0 - np.rint(matches.points0)).max(axis=1) < 1e-4
    whole1 = np.abs(matches.points1 - np.rint(matches.points1)).max(axis=1) < 1e-4
    assert (whole0 | whole1).all()
    np.testing.assert_array_equal(matches.scores == np.float32(0.3), whole0)
    assert set(matches.scores.tolist()) == {float(np.float32(0.3)), float(np.float32(0.9))}
    unsure = identity_warp(9, 9, 0.0), identity_warp(9, 9, 0.0)
    matcher = DkmMatcher(Given(*unsure), DenseOptions(), "cpu")
    assert len(match_one(matcher, picture(9, 9), picture(9, 9))) == 0
