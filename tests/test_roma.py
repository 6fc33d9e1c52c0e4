"""RoMa's parts by their definitions, on small numbers."""

import pytest
import torch

from mkpc_kaggle.matchers.networks.dinov2 import DinoV2, DinoV2Config
from mkpc_kaggle.matchers.networks.roma import anchor_mean


def centre(anchor):
    return torch.tensor([(2 * (anchor % 64) + 1) / 64 - 1, (2 * (anchor // 64) + 1) / 64 - 1])


@pytest.mark.parametrize(
    ("best", "near"),
    [
        (65 * 20, (1299, 1300, 1301, 1236, 1364)),
        (0, (0, 0, 1, 0, 64)),
        (4095, (4094, 4095, 4095, 4031, 4095)),
        (63, (62, 63, 64, 0, 127)),  # next to the last of a row is the first of the row below
        (128, (127, 128, 129, 64, 192)),
        (4032, (4031, 4032, 4033, 3968, 4095)),
    ],
)
def test_the_mean_of_the_best_anchor_and_its_neighbours(best, near):
    logits = torch.randn(2, 3, 4096, generator=torch.Generator().manual_seed(best))
    logits[..., best] += 9
    shares = logits.softmax(dim=-1)[..., list(near)]  # (2, 3, 5)
    places = torch.stack([centre(anchor) for anchor in near])
    expected = (shares[..., None] * places).sum(dim=2) / shares.sum(dim=2, keepdim=True)
    torch.testing.assert_close(anchor_mean(logits), expected, rtol=1e-5, atol=1e-6)


def cubic(distance, a=-0.75):
    """Keys' kernel, as PyTorch has it."""
    d = distance.abs()
    near, far = ((a + 2) * d - (a + 3)) * d**2 + 1, ((a * d - 5 * a) * d + 8 * a) * d - 4 * a
    return torch.where(d <= 1, near, far.where(d < 2, 0))


def test_positions_are_read_at_the_factors_places():
    network = DinoV2(DinoV2Config(width=3, blocks=1, heads=1, positions=6))
    stored = torch.randn(6, 3, generator=torch.Generator().manual_seed(0))  # all rows alike
    network.pos_embed[:, 1:] = stored.expand(6, 6, 3).reshape(1, 36, 3)
    places = (torch.arange(10) + 0.5) * 6 / 10.1 - 0.5
    taps = places.floor()[:, None] + torch.arange(-1, 3)  # (10, 4)
    weights = cubic(places[:, None] - taps)
    expected = (weights[:, :, None] * stored[taps.long().clamp(0, 5)]).sum(dim=1)
    grid = network.positions(4, 10)[0, 1:].view(4, 10, 3)
    torch.testing.assert_close(grid, expected.expand(4, 10, 3), rtol=1e-4, atol=1e-5)
    assert torch.equal(network.positions(6, 6), network.pos_embed)
    assert torch.equal(network.positions(4, 10)[:, :1], network.pos_embed[:, :1])
