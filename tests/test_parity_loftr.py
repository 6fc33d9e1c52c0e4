"""LoFTR against the golden vectors of its reference; run as a script it prints the table of differences."""

from functools import cache

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, print_table, ready, standin_state
from semi_dense import (
    assert_same_matches,
    check_batch_equals_single,
    check_empty,
    check_nothing_matches_padding,
    items_of,
    loftr_stages,
    random_network,
    textured,
)

from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.fine_matching import cut_windows
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, ORIGINAL_DECAY, sine_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import FeatureMaps

CASES = ("same_size", "diff_size", "masked_batch", "no_match")
TOLERANCES = dict.fromkeys(("feat_", "layer", "coarse", "conf", "mconf", "expec_f"), 1e-4)
TOLERANCES |= {"win": 2e-4, "fine": 2e-4, "mkpts1_f": 5e-4}


# exp rounds the seventh frequency, near a tie, one way on AMD, the other on Intel; 256 times it is 7.6e-6.
POSITION_TOLERANCES = {"chan_first24": 1e-6, "col": 1e-5, "corner": 1e-5}


@cache
def standin():
    return ready(Loftr(), standin_state("loftr"))


def stages_of(case):
    return loftr_stages("loftr", case, standin(), TOLERANCES)


def position_stages():
    golden = golden_arrays("loftr", "pos_encoding")
    for prefix, decay in (("buggy", ORIGINAL_DECAY), ("fixed", FIXED_DECAY)):
        table = sine_positions(256, 256, decay).permute(2, 0, 1)
        got = {"chan_first24": table[:24, :12, :16], "col": table[:, 7, 200], "corner": table[:, 255, 255]}
        for name, values in got.items():
            yield Stage(f"{prefix}_{name}", values, golden[f"{prefix}_{name}"], POSITION_TOLERANCES[name])


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_stages(case):
    assert_stages(stages_of(case))


@needs_golden
def test_position_tables():
    assert_stages(position_stages())


class SharpLoftr(Loftr):
    similarity_scale = 1 / (256 * 0.03)


def network(border=2):
    return random_network(lambda: SharpLoftr(0.0, border))


def test_batch_equals_single():
    check_batch_equals_single(network(border=0), (64, 96), (96, 64))


def test_nothing_matches_padding():
    check_nothing_matches_padding(network(border=1), (64, 80))


@torch.inference_mode()
def test_masked_padding_changes_nothing():
    """Whatever features the padding holds, the content matches as if it were cut out."""
    small = network(border=1)
    maps = [small.encode(textured(1, 1, 64, 80, seed=seed)) for seed in (1, 2)]
    padded, masks = [], []
    for features, (below, right) in zip(maps, ((3, 0), (1, 5)), strict=True):
        coarse = torch.nn.functional.pad(features.coarse, (0, right, 0, below), value=7.0)
        fine = torch.nn.functional.pad(features.fine, (0, 4 * right, 0, 4 * below), value=-3.0)
        padded.append(FeatureMaps(coarse, fine))
        masks.append(torch.nn.functional.pad(torch.ones(1, 8, 10), (0, right, 0, below)).bool())
    cropped, found = items_of(small.match(*maps), 0), items_of(small.match(*padded, tuple(masks)), 0)
    assert_same_matches(cropped[2:], found[2:])


@pytest.mark.parametrize("size", [(8, 8), (16, 8), (32, 40)])
@torch.inference_mode()
def test_tiny_pictures_match_nothing(size):
    small = network()
    check_empty(small.match(small.encode(textured(1, 1, *size)), small.encode(textured(1, 1, 8, 24))))


@pytest.mark.parametrize("size", [(60, 64), (64, 4), (0, 8)])
def test_sides_must_fit(size):
    with pytest.raises(ValueError, match="multiples of 8"):
        network().encode(torch.zeros(1, 1, *size))


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


def test_a_border_cell_suppresses_its_partner():
    grid = torch.eye(25).view(1, 5, 5, 25)
    other = grid.clone()
    other[0, 2, 2] = 0  # cell 12 has no partner but a border cell that likes it, too
    other[0, 0, 0] = 0.9 * grid[0, 2, 2]
    cells = coarse_matches(grid, other, 50.0, 0.0, 1, None).cell0.tolist()
    assert cells == [6, 7, 8, 11, 13, 16, 17, 18]


def test_windows_are_those_of_unfolding():
    fine = textured(2, 3, 16, 24)
    unfolded = torch.nn.functional.unfold(fine, 5, stride=4, padding=2).view(2, 3, 25, 24).permute(0, 3, 2, 1)
    batch, cells = torch.cartesian_prod(torch.arange(2), torch.arange(24)).T
    torch.testing.assert_close(cut_windows(fine, batch, cells), unfolded[batch, cells], rtol=0, atol=0)


if __name__ == "__main__":
    print_table("loftr", [*((case, stages_of(case)) for case in CASES), ("pos_encoding", position_stages())])
