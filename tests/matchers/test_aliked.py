"""ALIKED against kornia's on stand-in weights and on the real ones, and its parts by hand."""

import torch
from kornia.feature import ALIKED
from pictures import image_of
from shared import WEIGHTS, needs_weights
from sklearn.datasets import load_sample_image
from standin import STAND_INS, scene, standin_state

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.weights import load_tensors


def both(state, features=300):
    """Our network as it runs, and kornia's, where only the grid of a window is not a parameter."""
    theirs = ALIKED("aliked-n16", max_num_keypoints=features, detection_threshold=0.0).eval()
    grid = {"dkd.hw_grid": theirs.dkd.hw_grid}
    theirs.load_state_dict(state | grid)
    ours = Aliked(features)
    ours.load_state_dict({own_name(name): tensor for name, tensor in state.items()})
    return prepared(ours, Placement()), theirs


def standin():
    state = standin_state(ALIKED("aliked-n16"), STAND_INS["aliked"])
    del state["dkd.hw_grid"]
    return state


def assert_alike(found, expected):
    points, descriptors = found
    distances = torch.cdist(points.double(), expected.keypoints.double())
    nearest = distances.argmin(dim=1)
    assert len(points) == expected.n > 100
    assert (distances.amin(dim=1) < 0.01).double().mean() > 0.99
    assert (distances.amin(dim=0) < 0.01).double().mean() > 0.99
    close = distances.amin(dim=1) < 0.01
    cosines = (descriptors * expected.descriptors[nearest]).sum(dim=1)[close]
    # A coordinate within rounding of a whole pixel may take its offsets from the next pixel.
    assert (cosines > 0.9999).double().mean() > 0.99
    assert cosines.median() > 0.999999


@torch.inference_mode()
def test_it_finds_what_kornias_finds():
    ours, theirs = both(standin())
    images = torch.cat([image_of(scene(96, 160, 3)), image_of(scene(96, 160, 3, "another"))])
    for found, expected in zip(ours(images), theirs(images), strict=True):
        assert_alike(found, expected)


@needs_weights
@torch.inference_mode()
def test_it_finds_what_kornias_finds_with_the_published_weights():
    ours, theirs = both(load_tensors(WEIGHTS / "aliked-n16.safetensors"), 1000)
    photograph = image_of(load_sample_image("china.jpg")[:256, :320])
    assert_alike(ours(photograph)[0], theirs(photograph)[0])
