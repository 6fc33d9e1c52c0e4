"""ALIKED and SIFT with LightGlue, from checkpoints in the public format, with stand-in weights."""

import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from checkpoints import PublicFile, store_of
from pictures import picture
from torch import Tensor, nn

from mkpc_kaggle.matchers.adapters import aliked_lightglue, sift_lightglue
from mkpc_kaggle.matchers.adapters.aliked_lightglue import AlikedLightGlueOptions
from mkpc_kaggle.matchers.contract import Colour, Placement, Precision
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.lightglue import LightGlue, LightGlueShape
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.weights import WeightStore


def glue(shape: LightGlueShape) -> nn.Module:
    # Two of nine layers: names and shapes are the same, and files are small.
    return LightGlue(replace(shape, layers=2))


def old_names(state: dict[str, Tensor]) -> dict[str, Any]:
    """As the older public files name a layer's attentions, with their surplus entry."""
    pattern = r"^transformers\.(\d+)\.(self|cross)_attn"
    renamed = {re.sub(pattern, r"\2_attn.\1", name): tensor for name, tensor in state.items()}
    return renamed | {"log_assignment.0.r": torch.zeros(1)}


def published_aliked(state: dict[str, Tensor]) -> dict[str, Any]:
    pattern = r"(block[34]\.conv[12])\.weight"
    return {re.sub(pattern, r"\1.regular_conv.weight", name): x for name, x in state.items()}


ALIKED = partial(glue, aliked_lightglue.SHAPE)
SIFT = partial(glue, sift_lightglue.SHAPE)
EVERY = {"depth_confidence": -1.0, "width_confidence": -1.0}  # all layers on all keypoints
KEYPOINTS = partial(Aliked, 2048)
FILES = (
    PublicFile(
        "a.pth", "aliked_lightglue", "aliked-n16", "aliked", KEYPOINTS, published_aliked
    ),
    PublicFile(
        "b.pth", "aliked_lightglue", "aliked-lightglue", "lightglue", ALIKED, old_names
    ),
    PublicFile("c.pth", "sift_lightglue", "sift-lightglue", "lightglue", SIFT, old_names),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    return store_of(tmp_path_factory.mktemp("weights"), FILES)


@pytest.mark.parametrize("name", ["aliked_lightglue", "sift_lightglue"])
def test_a_picture_matches_itself_point_by_point(name, store):
    options = replace(
        spec_of(name, "test").options(), features=300, **EVERY, filter_threshold=0.0
    )
    matcher = load_matcher(name, store, options, Placement())
    channels = 1 if matcher.spec.colour is Colour.GRAY else 3
    encodings = matcher.encode([picture(97, 131, channels=channels, multiple=32)])
    (matches,) = matcher.match(encodings, encodings)
    # With stand-in weights, only equal descriptors at equal positions are sure to match.
    assert 50 < len(encodings[0]) <= 300
    assert len(matches) > 0.9 * len(encodings[0])
    assert (matches.points0 == matches.points1).all(axis=1).mean() > 0.9


@pytest.mark.parametrize("precision", Precision)
def test_layers_compute_in_the_precision_that_is_asked_for(precision, store):
    """Weights of the layers are rounded; positions, confidences and scores stay float32."""
    options = AlikedLightGlueOptions(features=300)
    matcher = load_matcher("aliked_lightglue", store, options, Placement(precision=precision))
    state = matcher._glue.state_dict()
    # And layer norms
    is_exact = re.compile(r"posenc|log_assignment|token_confidence|\.ffn\.1\.")
    half = getattr(torch, precision)
    expected = {name: torch.float32 if is_exact.search(name) else half for name in state}
    assert {name: tensor.dtype for name, tensor in state.items()} == expected
    encodings = matcher.encode([picture(64, 96, multiple=32)])
    (matches,) = matcher.match(encodings, encodings)
    assert matches.scores.dtype == np.float32
