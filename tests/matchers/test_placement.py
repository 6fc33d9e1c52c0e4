"""A network made ready to run: batch norms folded away, half precision where it is meant to be."""

import pytest
import torch
from torch import nn

from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.networks.layers import Linear
from mkpc_kaggle.matchers.networks.placement import fold_norms, prepared
from mkpc_kaggle.matchers.networks.resnet_fpn import ResNetFpn


def with_random_norms(network):
    """In evaluation mode, with norms that do something."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            for tensor in (module.weight, module.bias, module.running_mean):
                tensor.data.normal_()
            module.running_var.uniform_(0.1, 2)
    return network.eval().requires_grad_(False)


@pytest.mark.parametrize("bias", [False, True])
@torch.inference_mode()
def test_a_norm_goes_into_the_convolution_before_it(bias):
    torch.manual_seed(0)
    network = with_random_norms(nn.Sequential(nn.Conv2d(3, 6, 3, 2, 1, bias=bias), nn.BatchNorm2d(6), nn.ReLU()))
    x = torch.randn(2, 3, 9, 8)
    expected = network(x)
    fold_norms(network)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in network.modules())
    torch.testing.assert_close(network(x), expected, rtol=1e-5, atol=1e-5)


@torch.inference_mode()
def test_a_placed_backbone_gives_the_same_maps_channels_last():
    torch.manual_seed(2)
    network = with_random_norms(ResNetFpn())
    image = torch.rand(1, 1, 32, 48)
    expected = network(image)
    found = prepared(network, Placement())(image)
    for got, map_ in ((found.coarse, expected.coarse), (found.fine, expected.fine)):
        torch.testing.assert_close(got, map_, rtol=1e-4, atol=1e-4 * map_.abs().max().item())
    assert found.fine.is_contiguous(memory_format=torch.channels_last)


@torch.inference_mode()
def test_half_precision_is_that_of_the_weights():
    torch.manual_seed(3)
    network = nn.Sequential(Linear(8, 8), nn.LayerNorm(8))
    x = torch.randn(5, 8)
    expected = network(x)
    found = prepared(network, Placement(precision=Precision.BFLOAT16))(x)
    assert network[0].weight.dtype == torch.bfloat16 and network[1].weight.dtype == torch.float32
    assert found.dtype == torch.float32
    assert 0 < (found - expected).abs().max() < 0.1
