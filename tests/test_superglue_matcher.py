"""SuperPoint + SuperGlue as a matcher, from checkpoints in the public files' own format, with random weights."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers import superglue
from mkpc_kaggle.matchers.contract import Picture, Placement, Training
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.weights import UNVERIFIED, WeightFile, WeightStore

OPTIONS = superglue.SuperGlueOptions(max_keypoints=300, keypoint_threshold=0.0, match_threshold=0.0)
pytestmark = pytest.mark.filterwarnings("ignore:.*is not verified")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    directory = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    for name, network in (("sp.pth", SuperPoint()), ("sg.pth", SuperGlue())):
        torch.save(network.state_dict(), directory / name)
    files = [
        WeightFile(name, -1, UNVERIFIED, "none", slot, "made here")
        for name, slot in (
            ("sp.pth", "superpoint"),
            ("sg.pth", "superglue-outdoor"),
            ("sg.pth", "superglue-indoor"),
        )
    ]
    return WeightStore([directory], files)


@pytest.fixture(scope="module")
def matcher(store: WeightStore) -> superglue.SuperGlueMatcher:
    return superglue.load(store, OPTIONS, Placement())


def textured(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (height // 4 + 1, width // 4 + 1), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def picture(pixels: np.ndarray) -> Picture:
    size = Size(pixels.shape[1], pixels.shape[0])
    return Picture(pixels, View(Box.whole(size), size, size))


def test_the_other_way_round_the_same_keypoints_are_paired(matcher: superglue.SuperGlueMatcher) -> None:
    first, second = matcher.encode([picture(textured(120, 160, seed)) for seed in (0, 1)])
    (there,), (back,) = matcher.match([first], [second]), matcher.match([second], [first])
    pairs = {(*a, *b) for a, b in zip(there.points0.tolist(), there.points1.tolist(), strict=True)}
    assert pairs
    assert pairs == {(*a, *b) for a, b in zip(back.points1.tolist(), back.points0.tolist(), strict=True)}


@pytest.mark.parametrize("pixels", [np.full((60, 80), 128, np.uint8), np.zeros((5, 300), np.uint8)])
def test_pictures_without_keypoints_have_no_matches(store: WeightStore, pixels: np.ndarray) -> None:
    picky = superglue.load(store, superglue.SuperGlueOptions(keypoint_threshold=0.9), Placement())
    encodings = picky.encode([picture(pixels)] * 2)
    assert [len(matches) for matches in picky.match(encodings[:1], encodings[1:])] == [0]
    assert picky.encode([]) == []


def test_indoor_weights_are_another_slot(store: WeightStore) -> None:
    indoor = superglue.SuperGlueOptions(training=Training.INDOOR)
    assert superglue.SPEC.slots_for(indoor) == ("superpoint", "superglue-indoor")
    outdoor_alone = WeightStore(store.directories, store.files[:2])
    assert superglue.load(store, indoor, Placement()).spec is superglue.SPEC
    with pytest.raises(KeyError, match="superglue-indoor"):
        superglue.load(outdoor_alone, indoor, Placement())


def test_another_networks_checkpoint_is_refused(store: WeightStore, tmp_path: Path) -> None:
    torch.save({"weight": torch.ones(3)}, tmp_path / "sp.pth")
    swapped = WeightStore([tmp_path, *store.directories], store.files)
    with pytest.raises(UserError, match="'superpoint' do not fit the network"):
        superglue.load(swapped, OPTIONS, Placement())
