"""A network made ready to run: batch norms folded away, half precision where it is meant to be."""

import pytest
import torch
from torch import nn

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.placement import prepared


@pytest.mark.parametrize("bias", [False, True])
@torch.inference_mode()
def test_a_norm_goes_into_the_convolution_before_it(bias):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 6, 3, 2, 1, bias=bias), nn.BatchNorm2d(6), nn.ReLU()).eval()
    for tensor in (network[1].weight, network[1].bias, network[1].running_mean):
        tensor.data.normal_()
    network[1].running_var.uniform_(0.1, 2)
    x = torch.randn(2, 3, 9, 8)
    expected = network(x)
    found = prepared(network, Placement())(x)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in network.modules())
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
