"""Every matcher on the device double: nothing mixes devices, and the matches are those of the CPU.

``PYTHONPATH=.:tests/support python tests/test_device_double.py`` prints the table, of some of the batches if they
are named: matcher, precision, devices, batch, equal matches.
"""

import os
import sys
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from device_double import DeviceDouble
from light_matchers import MATCHERS, SHIFT, picture
from torch.nn.attention import SDPBackend, sdpa_kernel

from mkpc_kaggle.matchers.contract import Placement, Precision

DEVICES = {1: ("cuda:0",), 2: ("cuda:0", "cuda:1")}
BATCHES = (1, 3, 8)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


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


@cache
def on_cpu(name: str, precision: Precision, batch: int) -> list[Any]:
    """With attention by its definition, as the double has it: another order of sums chooses other anchors."""
    with sdpa_kernel(SDPBackend.MATH):
        return matched(name, Placement("cpu", precision), batch)


def on_double(name: str, precision: Precision, devices: tuple[str, ...], batch: int) -> list[list[Any]]:
    """What each of the devices finds."""
    with DeviceDouble(len(devices)) as double:
        found = [matched(name, Placement(device, precision), batch) for device in devices]
        assert double.operators > 0
    return found


def agreement(first: Any, second: Any, within: float = 0.05) -> float:
    """The share of either's matches that lie within so many pixels, in both images, of a match of the other."""
    rows = [torch.from_numpy(np.hstack([matches.points0, matches.points1])) for matches in (first, second)]
    if not len(rows[0]) or not len(rows[1]):
        return float(len(rows[0]) == len(rows[1]))
    near = torch.cdist(*rows, p=torch.inf, compute_mode="donot_use_mm_for_euclid_dist") <= within
    return ((near.any(1).sum() + near.any(0).sum()) / sum(map(len, rows))).item()


def compared(name: str, precision: Precision, devices: int, batch: int) -> tuple[int, float]:
    """How many matches there are on the CPU, and the least agreement of a pair."""
    expected = on_cpu(name, precision, batch)
    found = on_double(name, precision, DEVICES[devices], batch)
    agreements = [agreement(*pair) for each in found for pair in zip(each, expected, strict=True)]
    return sum(map(len, expected)), min(agreements)


CASES = [
    (name, precision, devices, batch)
    for name in MATCHERS
    for precision in Precision
    for devices in DEVICES
    for batch in BATCHES
]
HALVED = ("superglue", "aliked_lightglue", "xfeat_lighterglue")
QUICK = {(name, Precision.FLOAT32, 2, 1) for name in MATCHERS if name != "dkm, two passes"}
QUICK |= {(name, Precision.FLOAT16, 1, 3) for name in HALVED}
# Of the matches, at least. In half precision the order of sums tells.
SAME = {Precision.FLOAT32: 0.98, Precision.FLOAT16: 0.7, Precision.BFLOAT16: 0.5}


@pytest.mark.parametrize(
    ("name", "precision", "devices", "batch"),
    [case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow) for case in CASES],
)
def test_a_matcher_finds_on_a_gpu_what_it_finds_on_the_cpu(name, precision, devices, batch):
    number, agreed = compared(name, precision, devices, batch)
    assert number > 0
    assert agreed >= SAME[precision]


def main() -> None:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    batches = [int(batch) for batch in sys.argv[1:]] or BATCHES
    print(
        f"| matcher | precision | devices | batch | matches on the CPU | the same within 0.05 px |\n|{'---|' * 6}"
    )
    for name, precision, devices, batch in CASES:
        if batch in batches:
            number, agreed = compared(name, precision, devices, batch)
            told = "all" if agreed == 1 else f"{agreed:.1%} in the worst pair"
            print(f"| {name} | {precision} | {devices} | {batch} | {number} | {told} |", flush=True)


if __name__ == "__main__":
    main()
