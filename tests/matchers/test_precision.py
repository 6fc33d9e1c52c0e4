"""Half precision changes matches less than a grey level of noise in the pictures does.

The weights are stand-ins, so the bounds are of the arithmetic, not of the matching.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from light_matchers import MATCHERS, SHIFT, picture
from pictures import agreement

from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.devices import fastest_precision, resolve_placement

NAMES = ["superglue", "loftr", "quadtree", "aspanformer", "roma", "loma", "xfeat_lighterglue"]


@cache
def matches_of(name, precision=Precision.FLOAT32, noise=0):
    """(M, 4): the points of both pictures; with noise, each value is changed by up to one."""
    matcher = MATCHERS[name](Placement(precision=precision))
    encodings = []
    for shift in (SHIFT, 0):
        shown = picture(matcher.spec.colour, 0, shift)
        change = np.random.default_rng(0).integers(-noise, noise + 1, shown.pixels.shape)
        pixels = (shown.pixels + change).clip(0, 255).astype(np.uint8)
        encodings.append(matcher.encode([replace(shown, pixels=pixels)]))
    (found,) = matcher.match(*encodings)
    return torch.from_numpy(np.hstack([found.points0, found.points1]))


@pytest.mark.parametrize("name", NAMES)
def test_half_precision_moves_matches_less_than_noise_does(name):
    exact = matches_of(name)
    half = matches_of(name, Precision.FLOAT16)
    disturbed = matches_of(name, noise=1)
    assert len(exact) > 20
    # A grey level is the noise that every photograph has.
    assert agreement(exact, half, within=0.25) > agreement(exact, disturbed, within=0.25)
    # Equal matches would mean that the precision was ignored.
    assert not torch.equal(exact, half)


def test_auto_takes_half_precision_where_the_processor_has_it(monkeypatch):
    # Without these instructions, PyTorch emulates bfloat16 and is slower than in float32.
    for flags, expected in (
        ({"avx512_bf16": True}, Precision.BFLOAT16),
        ({"amx_bf16": True, "avx512_bf16": False}, Precision.BFLOAT16),
        ({"avx2": True}, Precision.FLOAT32),
    ):
        monkeypatch.setattr(
            torch.cpu, "get_capabilities", lambda flags=flags: flags, raising=False
        )
        assert resolve_placement("cpu", "auto") == Placement("cpu", expected)
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert fastest_precision("cpu") is Precision.FLOAT32
