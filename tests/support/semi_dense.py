"""What tests of the semi-dense networks share."""

import torch


def random_network(make, gain=3.0):
    """The network with seeded random weights, whose features differ enough to be matched."""
    torch.manual_seed(0)
    network = make()
    with torch.no_grad():
        network.backbone.layer3_outconv.weight.mul_(gain)
    return network


def textured(*shape, seed=1):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def check_empty(matches):
    coarse = matches.coarse
    for cells in (coarse.batch, coarse.cell0, coarse.cell1):
        assert cells.shape == (0,) and cells.dtype == torch.int64
    assert coarse.confidence.shape == (0,)
    assert matches.points0.shape == matches.points1.shape == (0, 2)
    assert matches.expectation.shape == (0, 3)
