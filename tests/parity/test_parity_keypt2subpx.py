"""Keypt2Subpx with the published weights against its golden vectors, and what must hold of any weights."""

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden
from shared import WEIGHTS, needs_weights

from mkpc_kaggle.matchers.networks.keypt2subpx import Keypt2Subpx, patches_at
from mkpc_kaggle.weights import load_into, load_tensors

DIMENSIONS = {"xfeat": (64, 1), "aliked": (128, 2)}


def published(name):
    network = Keypt2Subpx(*DIMENSIONS[name])
    load_into(network, load_tensors(WEIGHTS / f"keypt2subpx-{name}.safetensors"), what=name)
    return network


@needs_golden
@needs_weights
@pytest.mark.parametrize("name", DIMENSIONS)
@torch.inference_mode()
def test_keypoints_move_as_the_golden_ones(name):
    golden, network = golden_arrays("keypt2subpx", name), published(name)

    def refined(number, descriptors):
        channels = [golden[key] for key in (f"image{number}", f"score{number}") if key in golden]
        points = golden[f"keypoints{number}"]
        return points + network(patches_at(torch.stack(channels), points), descriptors)

    mean = (golden["descriptors0"] + golden["descriptors1"]) / 2
    assert_stages(
        [
            Stage("refined0", refined(0, mean), golden["refined0"], 1e-4),
            Stage("refined1", refined(1, mean), golden["refined1"], 1e-4),
            Stage("own0", refined(0, golden["descriptors0"]), golden["own0"], 1e-4),
        ]
    )


def test_patches_are_centred_on_whole_pixels_and_zero_beyond_the_border():
    image = torch.arange(1.0, 15 * 20 + 1).view(1, 15, 20)
    points = torch.tensor([[7.9, 6.2], [0, 0], [19, 14], [18, 13]])
    patches = patches_at(image, points)
    assert torch.equal(patches[0], image[:, 1:12, 2:13])
    assert patches[1, 0, :5].count_nonzero() == patches[1, 0, :, :5].count_nonzero() == 0
    assert torch.equal(patches[1, 0, 5:, 5:], image[0, :6, :6])
    assert torch.equal(patches[2], patches[3])
    assert patches[3, 0, 5, 5] == image[0, 13, 18]


def test_a_point_moves_at_most_five_pixels_and_no_points_are_legal():
    torch.manual_seed(0)
    network = Keypt2Subpx(64)
    offsets = network(torch.rand(9, 1, 11, 11), 5 * torch.randn(9, 64))
    assert offsets.shape == (9, 2)
    assert 0.1 < offsets.abs().max() <= 5
    assert network(torch.zeros(0, 1, 11, 11), torch.zeros(0, 64)).shape == (0, 2)
