"""DKM: what must hold of any weights, and by hand on small maps."""

import pytest
import torch

from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import dense_warp
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.warp_refiner import WarpEstimate


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


def warp_and_certainty(count=3000, seed=5):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 4, generator=generator) * 2 - 1, torch.rand(count, generator=generator) ** 4


def test_balancing_spreads_the_matches():
    generator = torch.Generator().manual_seed(7)
    crowd = torch.rand(9000, 4, generator=generator) * 0.1
    thin = torch.rand(1000, 4, generator=generator) * 0.1 - 0.9
    warp, certainty = torch.cat([crowd, thin]), torch.ones(10000)
    matches = sample_matches(warp, certainty, 500, generator=generator).matches
    assert (matches[:, 0] < 0).float().mean() > 0.2


def test_what_has_no_weight_is_not_drawn():
    warp, certainty = warp_and_certainty(100)
    certainty[10:] = 0
    found = sample_matches(warp, certainty, 50)
    assert sorted(found.matches.tolist()) == sorted(warp[:10].tolist())
    assert len(sample_matches(warp, certainty * 0, 50).matches) == 0
    assert len(sample_matches(warp[:0], certainty[:0], 50).matches) == 0
    with pytest.raises(ValueError, match="finite"):
        sample_matches(warp, certainty.index_fill(0, torch.tensor([3]), float("nan")), 50)
