"""SuperPoint + SuperGlue as a matcher, from checkpoints in the public files' own format, with random weights."""

import pytest
import torch
from pictures import picture, write_store

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.adapters import superglue
from mkpc_kaggle.matchers.contract import Placement, Training
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.weights import WeightStore

OPTIONS = superglue.SuperGlueOptions(max_keypoints=300, keypoint_threshold=0.0, match_threshold=0.0)
pytestmark = pytest.mark.filterwarnings("ignore:.*is not verified")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    torch.manual_seed(0)
    states = {"sp.pth": SuperPoint().state_dict(), "sg.pth": SuperGlue().state_dict()}
    slots = [("sp.pth", "superpoint"), ("sg.pth", "superglue-outdoor"), ("sg.pth", "superglue-indoor")]
    return write_store(tmp_path_factory.mktemp("weights"), states, slots)


def test_the_other_way_round_the_same_keypoints_are_paired(store):
    matcher = superglue.load(store, OPTIONS, Placement())
    first, second = matcher.encode([picture(120, 160, name, channels=1) for name in ("scene", "another")])
    (there,), (back,) = matcher.match([first], [second]), matcher.match([second], [first])
    pairs = {(*a, *b) for a, b in zip(there.points0.tolist(), there.points1.tolist(), strict=True)}
    assert pairs
    assert pairs == {(*a, *b) for a, b in zip(back.points1.tolist(), back.points0.tolist(), strict=True)}


def test_indoor_weights_are_another_slot_and_another_networks_checkpoint_is_refused(store, tmp_path):
    indoor = superglue.SuperGlueOptions(training=Training.INDOOR)
    assert superglue.SPEC.slots_for(indoor) == ("superpoint", "superglue-indoor")
    with pytest.raises(UserError, match="superglue-indoor"):
        superglue.load(WeightStore(store.directories, store.files[:2]), indoor, Placement())
    torch.save({"weight": torch.ones(3)}, tmp_path / "sp.pth")
    with pytest.raises(UserError, match="'superpoint' do not fit the network"):
        superglue.load(WeightStore([tmp_path, *store.directories], store.files), OPTIONS, Placement())
