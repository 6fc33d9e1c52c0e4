"""DKM: what must hold of any weights, and by hand on small maps."""

from functools import cache

import pytest
import torch
from dense import side_by_side
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import dense_warp
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.warp_refiner import WarpEstimate, local_correlation


@cache
def network():
    """Random weights that keep activations, and so the flow, of order 1."""
    torch.manual_seed(0)
    network = DKM()
    for parameter in network.parameters():
        if parameter.ndim > 1:
            parameter.normal_(std=parameter[0].numel() ** -0.5)
    return network


def images(count, height, width, seed=0):
    """Normalised noise with some texture at all scales."""
    generator = torch.Generator().manual_seed(seed)
    layers = [
        functional.interpolate(torch.randn(count, 3, n, n, generator=generator), (height, width), mode="bicubic")
        for n in (2, 5, 17)
    ]
    return sum(layers)


def features(count=1, size=(45, 61), fine=None, seed=0):
    return network().encode(images(count, *size, seed), None if fine is None else images(count, *fine, seed))


@torch.inference_mode()
@pytest.mark.parametrize("fine", [None, (70, 83)])
def test_a_batch_finds_what_its_pairs_give_alone(fine):
    query, support = features(2, fine=fine), features(2, fine=fine, seed=1)
    found = side_by_side(network().match(query, support))
    for i in range(2):
        alone = [
            network().encode(
                images(2, 45, 61, seed)[i : i + 1], None if fine is None else images(2, *fine, seed)[i : i + 1]
            )
            for seed in (0, 1)
        ]
        expected = side_by_side(network().match(*alone))
        torch.testing.assert_close(found.warp[i], expected.warp[0], rtol=0, atol=1e-3)
        # A pixel within rounding of the border may count as outside in one of them.
        off = (found.certainty[i] - expected.certainty[0]).abs() > 1e-3
        assert off.float().mean() < 1e-3


@torch.inference_mode()
def test_corrections_are_in_pixels_of_the_query_however_large_the_support_is(monkeypatch):
    decoder = network().decoder
    monkeypatch.setattr(decoder.conv_refiner["8"], "forward", lambda query, support, flow: torch.ones(1, 3, 6, 8))
    query, support = (network().encode(images(1, *size)).coarse for size in ((48, 64), (72, 40)))
    estimate = WarpEstimate(torch.zeros(1, 2, 6, 8), torch.zeros(1, 1, 6, 8))
    for other in (query, support):
        flow = decoder.correct(estimate, query, other, 8).flow
        torch.testing.assert_close(flow[0, :, 0, 0], torch.tensor([2 / 8, 2 / 6]) / 8)


@given(
    radius=st.integers(1, 4),
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    support_size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    spread=st.sampled_from([0.5, 1.5, 20]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=50, deadline=None)
def test_local_correlation_is_its_definition(radius, size, support_size, spread, seed):
    generator = torch.Generator().manual_seed(seed)
    h, w = size
    query = torch.randn(2, 5, *size, generator=generator)
    support = torch.randn(2, 5, *support_size, generator=generator)
    flow = torch.randn(2, 2, *size, generator=generator) * spread
    offsets = [(a, b) for a in range(-radius, radius + 1) for b in range(-radius, radius + 1)]
    expected = []
    for a, b in offsets:
        target = flow.permute(0, 2, 3, 1) + torch.tensor([2 * b / w, 2 * a / h])
        expected.append((query * functional.grid_sample(support, target, align_corners=False)).sum(1) / 5**0.5)
    got = local_correlation(query, support, flow, radius)
    torch.testing.assert_close(got, torch.stack(expected, dim=1), rtol=1e-4, atol=2e-4)


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
    both = side_by_side((found, sure.swapped()))
    assert torch.equal(both.warp[0, 0, 3], torch.tensor([1, 0, 0.5, -0.5]))


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
