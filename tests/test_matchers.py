"""Every matcher against pictures whose correspondence is known, and against pictures that have none."""

from dataclasses import fields, is_dataclass
from enum import StrEnum
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from shared import WEIGHTS, needs_weights
from sklearn.datasets import load_sample_image
from torch import nn

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.contract import Colour, Picture, Placement
from mkpc_kaggle.matchers.lightglue import layer_name
from mkpc_kaggle.matchers.registry import load_matcher, matcher_names, spec_of
from mkpc_kaggle.weights import WeightStore, load_into

SIZE = Size(256, 192)
every_matcher = pytest.mark.parametrize(
    "name",
    ["sift", pytest.param("aliked", marks=needs_weights), pytest.param("xfeat_lighterglue", marks=needs_weights)],
)
# The median error in pixels that a matcher may have; XFeat's keypoints are whole pixels of its cells.
WITHIN = {"sift": 0.4, "aliked": 1.0, "xfeat_lighterglue": 1.5}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small pictures gain nothing from more, and on a busy machine threads that wait for one another cost."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def affine(degrees, scale, x, y):
    """Rotation and scaling about the middle, then a shift; (3, 3) in pixel coordinates."""
    matrix = cv2.getRotationMatrix2D(((SIZE.width - 1) / 2, (SIZE.height - 1) / 2), degrees, scale)
    matrix[:, 2] += (x, y)
    return np.vstack([matrix, [0, 0, 1]])


MAPS = {
    "shifted": affine(0, 1, 32, -32),
    "rotated": affine(12, 1, 3, 2),
    "smaller": affine(0, 0.75, 0, 0),
    "larger": affine(0, 1.3, 0, 0),
}


@cache
def photograph():
    # Twice reduced, it is sharp at this size.
    return cv2.resize(load_sample_image("china.jpg")[:, :569], SIZE, interpolation=cv2.INTER_AREA)


@cache
def matcher_of(name):
    options = spec_of(name, "test").options(features=1000)
    return load_matcher(name, WeightStore([WEIGHTS] if WEIGHTS.is_dir() else []), options, Placement())


def picture(pixels, matcher, padding=(0, 0)):
    """(H, W, 3) RGB as that matcher wants it, one to one, with at least that padding in pixels."""
    if matcher.spec.colour is Colour.GRAY:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    content = Size(pixels.shape[1], pixels.shape[0])
    multiple = matcher.spec.multiple
    padded = [-(-(side + more) // multiple) * multiple for side, more in zip(content, padding, strict=True)]
    view = View(Box.whole(content), content, Size(*padded))
    return Picture(view.render(pixels), view)


@cache
def photograph_encoding(name):
    matcher = matcher_of(name)
    return matcher.encode([picture(photograph(), matcher)])[0]


def match_photograph(name, pixels):
    """Matches of the photograph, image 0, and other pixels, image 1."""
    matcher = matcher_of(name)
    return matcher.match([photograph_encoding(name)], matcher.encode([picture(pixels, matcher)]))[0]


def offsets(matches, H):
    """(N, 2): where image 1's points are, less where the map puts image 0's."""
    true = cv2.perspectiveTransform(matches.points0[None].astype(np.float64), H)[0]
    return matches.points1 - true


# what is said of them


def test_the_registry_knows_the_matchers_of_the_recipes():
    assert {"sift", "aliked", "xfeat_lighterglue"} <= set(matcher_names())


def test_every_spec_makes_sense():
    for name in matcher_names():
        spec = spec_of(name, "test")
        assert (spec.name, bool(spec.summary), spec.multiple >= 1) == (name, True, True)
        assert is_dataclass(spec.options)
        spec.options()  # every option has a default
        assert bool(spec.slots) == bool(spec.licences)
        kinds = {field.type for field in fields(spec.options)} - {int, float, bool, str}
        assert all(issubclass(kind, StrEnum) for kind in kinds)


@every_matcher
def test_a_loaded_matcher_has_the_spec_of_the_registry(name):
    assert matcher_of(name).spec is spec_of(name, "test")


# what they find


@every_matcher
@pytest.mark.parametrize("kind", MAPS)
def test_matches_follow_the_known_map(name, kind):
    H = MAPS[kind]
    matches = match_photograph(name, cv2.warpPerspective(photograph(), H, SIZE, flags=cv2.INTER_AREA))
    assert len(matches) >= 60
    errors = np.hypot(*offsets(matches, H).T)
    assert np.median(errors) < WITHIN[name]
    assert np.mean(errors < 4) > 0.75
    assert Box.whole(SIZE).contains(matches.points0).all()
    assert Box.whole(SIZE).contains(matches.points1).all()
    assert np.isfinite(matches.scores).all()


def test_sift_puts_its_points_where_they_are_at_every_scale():
    """A constant offset shows between scales: d in both pictures is (1 - s) d between them."""
    for scale in (0.5, 2.0):
        size = Size(*(int(side * scale) for side in SIZE))
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        matches = match_photograph("sift", cv2.resize(photograph(), size, interpolation=method))
        H = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        off = offsets(matches, H)
        assert_allclose(np.median(off[np.hypot(*off.T) < 3], axis=0), 0, atol=0.06)


@every_matcher
def test_surer_matches_are_better_matches(name):
    H = MAPS["rotated"]
    matches = match_photograph(name, cv2.warpPerspective(photograph(), H, SIZE))
    good = np.hypot(*offsets(matches, H).T) < 3
    order = np.argsort(-matches.scores)
    half = len(order) // 2
    assert good[order[:half]].mean() >= good[order[half:]].mean()


@every_matcher
def test_matches_the_other_way_round_are_the_same_pairs(name):
    matcher = matcher_of(name)
    other = matcher.encode([picture(cv2.warpPerspective(photograph(), MAPS["smaller"], SIZE), matcher)])
    first = [photograph_encoding(name)]
    there, back = matcher.match(first, other)[0], matcher.match(other, first)[0]
    pairs = {(*a, *b) for a, b in zip(there.points0.tolist(), there.points1.tolist(), strict=True)}
    again = {(*a, *b) for a, b in zip(back.points1.tolist(), back.points0.tolist(), strict=True)}
    assert len(pairs & again) > 0.97 * len(pairs | again)


@every_matcher
def test_pictures_in_a_batch_are_encoded_as_they_are_alone(name):
    matcher = matcher_of(name)
    pictures = [picture(np.ascontiguousarray(cut), matcher) for cut in (photograph()[:96], photograph()[96:])]
    for together, one in zip(matcher.encode(pictures), pictures, strict=True):
        (alone,) = matcher.encode([one])
        assert len(together) == len(alone) > 50
        # As sets: rounding may change the order of scores, and what is the last of the best.
        distances = torch.cdist(together.points.double(), alone.points.double())
        assert (distances.amin(dim=1) < 1e-3).double().mean() > 0.99
        assert (distances.amin(dim=0) < 1e-3).double().mean() > 0.99


# pictures that have nothing, or little


ODD = {
    "flat": np.full((64, 96, 3), 128, np.uint8),
    "black": np.zeros((64, 96, 3), np.uint8),
    "one pixel": photograph()[:1, :1],
    "a strip": photograph()[100:103, :200],
    "tiny": photograph()[100:133, 100:147],
    "noise": np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8),
}


@every_matcher
@pytest.mark.parametrize("kind", ODD)
def test_odd_pictures_give_legal_matches(name, kind):
    matcher = matcher_of(name)
    odd = picture(ODD[kind], matcher, padding=(0, 40))
    (encoding,) = matcher.encode([odd])
    full = photograph_encoding(name)
    first, second = matcher.match([encoding, full], [full, encoding])
    content = Box.whole(odd.content)
    for points in (first.points0, second.points1):
        assert content.contains(points).all()
    for matches in (first, second):
        assert np.isfinite(matches.scores).all()


@every_matcher
def test_no_match_lies_on_the_padding_and_padding_costs_no_good_match(name):
    matcher = matcher_of(name)
    cut = np.ascontiguousarray(photograph()[:140, :180])
    padded = picture(cut, matcher, padding=(60, 50))
    assert padded.pixels.shape[:2] >= (190, 240)
    matches = matcher.match(matcher.encode([padded]), [photograph_encoding(name)])[0]
    assert Box.whole(padded.content).contains(matches.points0).all()
    errors = np.hypot(*(matches.points1 - matches.points0).T)  # the cut's corner is the photograph's
    assert np.sum(errors < 2) >= 60


# checkpoints


def test_a_checkpoint_with_a_surplus_or_a_missing_name_is_refused():
    network = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    whole = {name: torch.ones_like(tensor) for name, tensor in network.state_dict().items()}
    load_into(network, whole, unused="nothing", what="w")
    assert all((tensor == 1).all() for tensor in network.state_dict().values())
    for names in ({**whole, "2.bias": torch.ones(2)}, {k: v for k, v in whole.items() if k != "1.bias"}):
        with pytest.raises(UserError, match=r"'w' do not fit the network: [12]\.bias"):
            load_into(network, names, unused=r"0\.", what="w")


def test_a_checkpoint_may_lack_or_have_besides_what_is_not_used():
    network = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    before = network[1].bias.detach().clone()
    own = {name: torch.ones_like(tensor) for name, tensor in network.state_dict().items() if name != "1.bias"}
    load_into(network, {**own, "2.x": torch.ones(9)}, unused=r"1\.bias|2\.", what="w")
    assert torch.equal(network[1].bias, before)
    assert (network[0].weight == 1).all()


def test_a_tensor_of_another_shape_is_refused_by_its_name():
    network = nn.Sequential(nn.Linear(2, 2))
    wrong = {"0.weight": torch.ones(3, 2), "0.bias": torch.ones(2)}
    with pytest.raises(UserError, match=r"'w'.*0\.weight"):
        load_into(network, wrong, unused="nothing", what="w")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("self_attn.3.Wqkv.weight", "transformers.3.self_attn.Wqkv.weight"),
        ("matcher.cross_attn.0.to_qk.bias", "transformers.0.cross_attn.to_qk.bias"),
        ("transformers.1.self_attn.Wqkv.weight", "transformers.1.self_attn.Wqkv.weight"),
        ("posenc.Wr.weight", "posenc.Wr.weight"),
    ],
)
def test_older_names_of_layers_are_translated(old, new):
    assert layer_name(old) == new
