"""SuperPoint and SuperGlue: the matcher from checkpoints in the public format, and its parts by
hand.
"""

import pytest
import torch
from checkpoints import FILES, PublicFile, store_of
from standin import filled

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.adapters import superglue
from mkpc_kaggle.matchers.contract import Placement, Training
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.weights import WeightStore


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    files = [file for file in FILES if file.matcher == "superglue"]
    return store_of(tmp_path_factory.mktemp("weights"), files)


def test_indoor_weights_are_another_slot_and_another_networks_checkpoint_is_refused(
    store, tmp_path
):
    indoor = superglue.SuperGlueOptions(training=Training.INDOOR)
    assert superglue.SPEC.slots_for(indoor) == ("superpoint", "superglue-indoor")
    with pytest.raises(UserError, match="superglue-indoor"):
        superglue.load(store, indoor, Placement())
    # Renamed files happen: SuperGlue's tensors in the place of SuperPoint's.
    file = PublicFile("x.pth", "superglue", "superpoint", "superglue", SuperGlue)
    wrong = store_of(tmp_path, [file])
    with pytest.raises(UserError, match="'superpoint' do not fit the network"):
        superglue.load(wrong, superglue.SuperGlueOptions(), Placement())


def test_superpoint_finds_in_a_batch_what_it_finds_in_each_image():
    network = filled(SuperPoint(max_keypoints=20), "superpoint")
    batch = torch.rand(3, 1, 45, 62)
    for found, image in zip(network(batch), batch, strict=True):
        (alone,) = network(image[None])
        torch.testing.assert_close(found.scores, alone.scores, rtol=1e-4, atol=1e-7)
        assert torch.equal(found.points, alone.points)
        assert len(alone.points) == 20
        assert (alone.scores.diff() <= 0).all()
        # 45 x 62 pixels have 40 x 56 in whole cells of 8, less the border of 4.
        assert (alone.points >= 4).all()
        assert (alone.points < torch.tensor([56 - 4, 40 - 4])).all()
    assert network(batch[:0]) == []
