"""ALIKED and SIFT with LightGlue, from checkpoints in the public format, with stand-in weights."""

import re
from functools import partial
from typing import Any

import pytest
import torch
from checkpoints import PublicFile, store_of
from pictures import picture
from torch import Tensor, nn

from mkpc_kaggle.matchers.adapters.aliked import aliked_network
from mkpc_kaggle.matchers.contract import Colour, Placement, Precision
from mkpc_kaggle.matchers.lightglue import light_glue
from mkpc_kaggle.matchers.registry import load_matcher
from mkpc_kaggle.matchers.sparse import KeypointOptions
from mkpc_kaggle.weights import WeightStore


def glue(**shape: Any) -> nn.Module:
    return light_glue(2, input_dim=128, **shape)


def old_names(state: dict[str, Tensor]) -> dict[str, Any]:
    """As the public files name a layer's attentions; the thresholds are computed."""
    pattern, kept = r"^transformers\.(\d+)\.(self|cross)_attn", state.keys() - {"confidence_thresholds"}
    return {re.sub(pattern, r"\2_attn.\1", name): state[name] for name in kept}


def without_the_grid(state: dict[str, Tensor]) -> dict[str, Any]:
    return {name: tensor for name, tensor in state.items() if name != "dkd.hw_grid"}


ALIKED, SIFT = partial(aliked_network, 2048), partial(glue, add_scale_ori=True)
FILES = (
    PublicFile("a.pth", "aliked_lightglue", "aliked-n16", "aliked", ALIKED, without_the_grid),
    PublicFile("b.pth", "aliked_lightglue", "aliked-lightglue", "lightglue", glue, old_names),
    PublicFile("c.pth", "sift_lightglue", "sift-lightglue", "lightglue", SIFT, old_names),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    return store_of(tmp_path_factory.mktemp("weights"), FILES)


@pytest.mark.parametrize("name", ["aliked_lightglue", "sift_lightglue"])
def test_a_picture_matches_itself_point_by_point(name, store):
    matcher = load_matcher(name, store, KeypointOptions(features=300), Placement())
    matcher._glue.conf.filter_threshold = 0.0
    channels = 1 if matcher.spec.colour is Colour.GRAY else 3
    encodings = matcher.encode([picture(97, 131, channels=channels, multiple=32)])
    (matches,) = matcher.match(encodings, encodings)
    assert 50 < len(encodings[0]) <= 300
    assert len(matches) > 0.9 * len(encodings[0])
    assert (matches.points0 == matches.points1).all(axis=1).mean() > 0.9


@pytest.mark.parametrize("precision", Precision)
def test_layers_compute_in_the_precision_that_is_asked_for(precision, store):
    """LightGlue turns off any autocast around it: what counts is set around its layers."""
    placement, seen = Placement(precision=precision), []
    matcher = load_matcher("aliked_lightglue", store, KeypointOptions(), placement)
    for part in ("posenc.Wr", "transformers.1.cross_attn.to_out", "transformers.1", "log_assignment.1"):
        matcher._glue.get_submodule(part).register_forward_hook(lambda *call: seen.append(call[-1][0].dtype))
    encodings = matcher.encode([picture(64, 96, multiple=32)])
    matcher.match(encodings, encodings)
    exact = torch.float32
    assert seen == [exact, exact, *2 * [getattr(torch, precision)], exact, exact]
