"""LoFTR against the golden vectors of its reference."""

from functools import cache

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, ready, standin_state
from semi_dense import loftr_stages

from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, ORIGINAL_DECAY, sine_positions

CASES = ("same_size", "diff_size", "masked_batch", "no_match")
TOLERANCES = {"coarse": 1e-4, "conf": 1e-4, "mconf": 1e-4, "expec_f": 1e-4, "mkpts1_f": 5e-4}


# exp rounds the seventh frequency, near a tie, one way on AMD, the other on Intel; 256 times it is 7.6e-6.
POSITION_TOLERANCES = {"chan_first24": 1e-6, "col": 1e-5, "corner": 1e-5}


@cache
def standin():
    return ready(Loftr(), standin_state("loftr"))


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_stages(case):
    assert_stages(loftr_stages("loftr", case, standin(), TOLERANCES))


@needs_golden
def test_position_tables():
    golden, stages = golden_arrays("loftr", "pos_encoding"), []
    for prefix, decay in (("buggy", ORIGINAL_DECAY), ("fixed", FIXED_DECAY)):
        table = sine_positions(256, 256, decay).permute(2, 0, 1)
        got = {"chan_first24": table[:24, :12, :16], "col": table[:, 7, 200], "corner": table[:, 255, 255]}
        for name, values in got.items():
            whole = f"{prefix}_{name}"
            stages.append(Stage(whole, values, golden[whole], POSITION_TOLERANCES[name]))
    assert_stages(stages)


@pytest.mark.parametrize("held", [0, 2**20])
def test_matches_are_the_mutual_maxima_of_both_softmaxes(monkeypatch, held):
    monkeypatch.setattr("mkpc_kaggle.matchers.networks.coarse_matching.ROWS_AT_ONCE", {"cpu": 7})
    monkeypatch.setattr("mkpc_kaggle.matchers.networks.coarse_matching.HELD_FLOATS", held)
    generator = torch.Generator().manual_seed(0)
    grid0, grid1 = (torch.randn(2, 5, width, 16, generator=generator) for width in (6, 7))
    matches = coarse_matches(grid0, grid1, 0.5, 0.02, 0, None)
    similarity = (grid0.flatten(1, 2).double() @ grid1.flatten(1, 2).double().mT) * 0.5
    confidence = similarity.softmax(1) * similarity.softmax(2)
    mutual = (confidence == confidence.amax(1, keepdim=True)) & (confidence == confidence.amax(2, keepdim=True))
    expected = (mutual & (confidence > 0.02)).nonzero()
    torch.testing.assert_close(torch.stack([matches.batch, matches.cell0, matches.cell1], dim=1), expected)
    torch.testing.assert_close(matches.confidence.double(), confidence[tuple(expected.T)], rtol=1e-5, atol=0)
