"""ALIKED against kornia's on stand-in weights."""

import pytest
import torch
from kornia.feature import ALIKED
from pictures import agreement, picture
from standin import STAND_INS, standin_state

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.sparse import image_batch


def both(variant, positions):
    """Our network as it runs, and kornia's, where only the grid of a window is not a parameter."""
    theirs = ALIKED(variant, max_num_keypoints=300, detection_threshold=0.0).eval()
    state = standin_state(theirs, STAND_INS["aliked"])
    theirs.load_state_dict(state | {"dkd.hw_grid": theirs.dkd.hw_grid})
    ours = Aliked(300, positions)
    ours.load_state_dict(
        {own_name(name): state[name] for name in state if name != "dkd.hw_grid"}
    )
    return prepared(ours, Placement()), theirs


@pytest.mark.parametrize(("variant", "positions"), [("aliked-n16", 16), ("aliked-n32", 32)])
@torch.inference_mode()
def test_aliked_finds_the_keypoints_and_descriptors_of_kornias(variant, positions):
    ours, theirs = both(variant, positions)
    images = image_batch([picture(96, 160), picture(96, 160, "another")], "cpu")
    for (keypoints, descriptors), expected in zip(ours(images), theirs(images), strict=True):
        assert len(keypoints) == expected.n > 100
        both_points = keypoints.double(), expected.keypoints.double()
        # A near tie of the two weakest keypoints may fall the other way.
        assert agreement(*both_points, 0.01) > 0.99
        distances, nearest = torch.cdist(*both_points).min(dim=1)
        cosines = (descriptors * expected.descriptors[nearest]).sum(dim=1)[distances < 0.01]
        # A coordinate within rounding of a whole pixel may take its offsets from the next pixel.
        assert (cosines > 0.9999).double().mean() > 0.99
        assert cosines.median() > 0.999999
