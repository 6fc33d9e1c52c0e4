"""DKM and RoMa: their parts by hand, and the matchers' points and draws."""

import numpy as np
import pytest
import torch
from light_matchers import dkm_matcher, ours
from pictures import match_one, picture, same
from standin import narrow_roma

from mkpc_kaggle.matchers.adapters.dkm import DkmMatcher
from mkpc_kaggle.matchers.adapters.roma import RomaMatcher, RomaOptions
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.dense import DenseEncoding, DenseOptions
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseFeatures, DenseWarp, dense_warp
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.warp_refiner import WarpEstimate, identity_map


@torch.inference_mode()
def test_corrections_are_in_pixels_of_the_query_however_large_the_support_is(monkeypatch):
    network = DKM()
    monkeypatch.setattr(network.decoder.conv_refiner["8"], "forward", lambda *_: torch.ones(1, 3, 6, 8))
    query, support = (network.encode(torch.zeros(1, 3, *size)).coarse for size in ((48, 64), (72, 40)))
    estimate = WarpEstimate(torch.zeros(1, 2, 6, 8), torch.zeros(1, 1, 6, 8))
    for other in (query, support):
        flow = network.decoder.correct(estimate, query, other, 8).flow
        torch.testing.assert_close(flow[0, :, 0, 0], torch.tensor([2 / 8, 2 / 6]) / 8)


def test_targets_outside_have_no_certainty_and_coarse_doubts_count_half():
    flow = torch.zeros(1, 2, 2, 2)
    flow[0, 0, 0, 1], flow[0, 1, 1, 0], flow[0, :, 1, 1] = 1.001, -2, 1
    found = dense_warp(WarpEstimate(flow, torch.full((1, 1, 2, 2), -1.0)), torch.full((1, 1, 1, 1), -3.0))
    raised = torch.tensor(0.5).sigmoid()
    torch.testing.assert_close(found.certainty[0], raised * torch.tensor([[1, 0], [0, 1]]))
    assert found.warp[0, ..., 2:].tolist() == [[[0, 0], [1, 0]], [[0, -1], [1, 1]]]
    assert found.warp[0, ..., :2].tolist() == [[[-0.5, -0.5], [0.5, -0.5]], [[-0.5, 0.5], [0.5, 0.5]]]
    sure = dense_warp(WarpEstimate(flow, torch.full((1, 1, 2, 2), -1.0)), torch.full((1, 1, 1, 1), 3.0))
    torch.testing.assert_close(sure.certainty[0, 0, 0], torch.tensor(-1.0).sigmoid())
    assert torch.equal(sure.swapped().warp[0, 0, 1], torch.tensor([1, 0, 0.5, -0.5]))


def test_balancing_spreads_the_matches():
    generator = torch.Generator().manual_seed(7)
    crowd = torch.rand(9000, 4, generator=generator) * 0.1
    thin = torch.rand(1000, 4, generator=generator) * 0.1 - 0.9
    warp, certainty = torch.cat([crowd, thin]), torch.ones(10000)
    matches = sample_matches(warp, certainty, 500, generator=generator).matches
    assert (matches[:, 0] < 0).float().mean() > 0.2


def test_what_has_no_weight_is_not_drawn():
    warp, certainty = torch.rand(100, 4), torch.ones(100)
    certainty[10:] = 0
    found = sample_matches(warp, certainty, 50)
    assert sorted(found.matches.tolist()) == sorted(warp[:10].tolist())
    assert len(sample_matches(warp, certainty * 0, 50).matches) == 0
    assert len(sample_matches(warp[:0], certainty[:0], 50).matches) == 0
    with pytest.raises(ValueError, match="finite"):
        sample_matches(warp, certainty.index_fill(0, torch.tensor([3]), float("nan")), 50)


@pytest.fixture(scope="module")
def matcher() -> DkmMatcher:
    return dkm_matcher(Placement())


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


@pytest.mark.parametrize(("passes", "sides"), [(2, (56, 84)), (1, (84, 126))])
def test_sides_of_the_first_pass_are_multiples_of_14(passes: int, sides: tuple[int, int]) -> None:
    options = RomaOptions(passes=passes, first_pass=0.648)
    (encoded,) = RomaMatcher(ours(Placement(), "roma", narrow_roma), options, "cpu").encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape[2:] == sides
    assert [each.at(1).shape[2:] for each in [encoded.features.fine] if each] == [(86, 130)] * (passes - 1)
