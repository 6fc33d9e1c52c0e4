"""Every matcher on the device double: nothing mixes devices, and the matches are those of the CPU."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
import torch
from device_double import DeviceDouble
from light_matchers import MATCHERS, SHIFT, picture
from pictures import agreement
from torch.nn.attention import SDPBackend, sdpa_kernel

from mkpc_kaggle.matchers.contract import Placement, Precision


def matched(name: str, placement: Placement, batch: int) -> list[Any]:
    """``batch`` pairs encoded together, then matched together."""
    matcher = MATCHERS[name](placement)
    encodings = [
        matcher.encode([picture(matcher.spec.colour, number, shift) for number in range(batch)])
        for shift in (SHIFT, 0)
    ]
    assert {tensor.device for tensor in tensors_of(encodings)} == {torch.device(placement.device)}
    return list(matcher.match(*encodings))


def tensors_of(value: Any) -> list[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        return [value]
    if is_dataclass(value):
        return tensors_of([getattr(value, field.name) for field in fields(value)])
    return [tensor for part in value for tensor in tensors_of(part)] if isinstance(value, list | tuple) else []


def rows(matches: Any) -> torch.Tensor:
    return torch.from_numpy(np.hstack([matches.points0, matches.points1]))


CASES = [(name, Precision.FLOAT32, ("cuda:0", "cuda:1"), 1) for name in MATCHERS if name != "dkm, two passes"]
CASES += [
    (name, Precision.FLOAT16, ("cuda:0",), 3) for name in ("superglue", "aliked_lightglue", "xfeat_lighterglue")
]
SAME = {Precision.FLOAT32: 0.98, Precision.FLOAT16: 0.7}  # at least; in half precision the order of sums tells


@pytest.mark.parametrize(("name", "precision", "devices", "batch"), CASES)
def test_a_matcher_finds_on_a_gpu_what_it_finds_on_the_cpu(name, precision, devices, batch):
    with sdpa_kernel(SDPBackend.MATH):  # as the double has attention: another order of sums chooses other anchors
        expected = matched(name, Placement("cpu", precision), batch)
    with DeviceDouble(len(devices)) as double:
        found = [matched(name, Placement(device, precision), batch) for device in devices]
        assert double.operators > 0
    assert sum(map(len, expected)) > 0
    for each in found:
        shares = [agreement(rows(a), rows(b), 0.05, torch.inf) for a, b in zip(each, expected, strict=True)]
        assert min(shares) >= SAME[precision]
