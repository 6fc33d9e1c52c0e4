"""Every matcher on the device double: nothing mixes devices, and the CPU gives the same matches."""

import numpy as np
import pytest
import torch
from device_double import DeviceDouble
from light_matchers import MATCHERS, SHIFT, picture
from pictures import agreement
from torch.nn.attention import SDPBackend, sdpa_kernel

from mkpc_kaggle.matchers.contract import Placement, arrays_of

# In a minibatch; of others 1
PAIRS = {"superglue": 2, "aliked_lightglue": 2, "xfeat_lighterglue": 2}


def matched(name, device):
    """The points (M, 4) of each pair of a minibatch."""
    matcher = MATCHERS[name](Placement(device))
    encodings = []
    for shift in (SHIFT, 0):
        numbers = range(PAIRS.get(name, 1))
        side = [picture(matcher.spec.colour, number, shift) for number in numbers]
        encodings.append(matcher.encode(side))
    tensors = [array for array in arrays_of(encodings) if isinstance(array, torch.Tensor)]
    assert {tensor.device for tensor in tensors} == {torch.device(device)}
    found = matcher.match(*encodings)
    return [torch.from_numpy(np.hstack([each.points0, each.points1])) for each in found]


@pytest.mark.parametrize("name", MATCHERS)
def test_a_matcher_finds_on_a_gpu_what_it_finds_on_the_cpu(name):
    # As the double has attention: another order of sums chooses other anchors
    with sdpa_kernel(SDPBackend.MATH):
        expected = matched(name, "cpu")
    assert sum(map(len, expected)) > 0
    with DeviceDouble(2) as double:
        found = matched(name, "cuda:1")  # not the default one
        assert double.operators > 0
    # The double sums in another order, so a match at a threshold may come or go.
    for ours, of_cpu in zip(found, expected, strict=True):
        assert agreement(ours, of_cpu, 0.05, torch.inf) >= 0.98
