"""LoMa as a matcher, and properties of its networks that golden files do not show."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from checkpoints import FILES, store_of
from pictures import as_picture
from standin import scene

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.adapters import loma
from mkpc_kaggle.matchers.adapters.loma import LomaAdapter, LomaOptions
from mkpc_kaggle.matchers.contract import Placement, encoding_bytes
from mkpc_kaggle.matchers.networks import layers
from mkpc_kaggle.matchers.networks.loma import Loma, Variant, detector_size
from mkpc_kaggle.weights import WeightStore

OPTIONS = LomaOptions(Variant.B128, max_keypoints=200)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    files = [file for file in FILES if file.matcher == "loma"]
    return store_of(tmp_path_factory.mktemp("weights"), files)


@pytest.fixture(scope="module")
def matcher(store: WeightStore) -> LomaAdapter:
    return loma.load(store, OPTIONS, Placement())


@pytest.fixture(scope="module")
def network(matcher: LomaAdapter) -> Loma:
    return matcher._network


def test_keypoints_are_at_the_place_of_a_dot(matcher):
    """A dot stays in its place when the detector's picture has other sides than the view."""
    pixels = np.full((101, 135, 3), 90, np.uint8)
    cv2.circle(pixels, (70, 40), 2, (250, 240, 230), -1)
    (encoded,) = matcher.encode([as_picture(pixels)])
    assert detector_size(Size(135, 101), 135) == (128, 96)
    points = loma.from_normalised(encoded.keypoints.points.numpy(), Size(135, 101))
    distances = np.linalg.norm(points - (70, 40), axis=1)
    # Twice the dot's radius. With the detector's sides instead of the view's: 4.1 pixels off.
    assert distances.min() < 4


def test_padding_changes_nothing_and_tiny_pictures_have_no_matches(matcher):
    pixels = scene(75, 101, channels=3)
    shown = [as_picture(pixels), as_picture(pixels, padding=(13, 26))]
    plain, padded = matcher.encode(shown)
    assert torch.equal(plain.keypoints.points, padded.keypoints.points)
    assert torch.equal(plain.keypoints.descriptors, padded.keypoints.descriptors)
    # 200 keypoints, each with two coordinates and 128 numbers of four bytes.
    assert encoding_bytes(plain) == 200 * (2 + 128) * 4
    tiny = []
    for size in ((7, 90), (1, 1), (90, 5)):
        tiny += matcher.encode([as_picture(scene(*size, channels=3))])
    # Rounded down to the detector's multiple, they have no rows or no columns.
    found = matcher.match([*tiny, plain, tiny[0]], [plain] * 3 + tiny[:2])
    assert [len(matches) for matches in found] == [0] * 5


def test_a_checkpoint_with_surplus_tensors_is_refused_and_half_precision_and_more_layers_load(
    store, network
):
    good = store.load("loma-b128")
    surplus = {"_descriptor.surplus": torch.ones(1)}
    with_surplus = SimpleNamespace(load=lambda _: good | surplus)
    with pytest.raises(UserError, match="'loma-b128' do not fit the network"):
        loma.load(with_surplus, OPTIONS, Placement())
    # Published variants have more layers than the matcher runs, and some are stored in bfloat16.
    name = "transformers.3.self_attn.Wqkv.weight"
    more = {
        name: good[name].bfloat16(),
        "transformers.9.self_attn.out_proj.bias": torch.ones(256),
    }
    published = SimpleNamespace(load=lambda _: good | more)
    loaded = loma.load(published, OPTIONS, Placement())
    found = loaded._network.get_parameter(f"matcher.{name}")
    exact = network.get_parameter(f"matcher.{name}")
    assert torch.equal(found, exact.bfloat16().float())


@torch.inference_mode()
def test_strips_of_rows_give_what_the_whole_gives(network, monkeypatch):
    pixels = torch.from_numpy(scene(157, 83, channels=3))
    image = pixels.permute(2, 0, 1)[None].float() / 255
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(1, 50, 2, generator=generator) - 1
    logits = network.detector.logits(image)
    descriptors = network.descriptor(image, points)
    # Fifty rows of the first layer: strips meet within the picture, where they need a margin.
    monkeypatch.setattr(layers, "STRIP_FLOATS", 83 * 32 * 50)
    in_strips = network.detector.logits(image)
    torch.testing.assert_close(in_strips, logits, rtol=0, atol=1e-3)
    in_strips = network.descriptor(image, points)
    torch.testing.assert_close(in_strips, descriptors, rtol=0, atol=1e-3)
