"""All matchers of learned features with stand-in weights and no files; in light configurations by
default.

A new matcher is one line in ``MATCHERS``.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from torch import nn

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.adapters import (
    aliked,
    aliked_lightglue,
    dkm,
    roma,
    sift_lightglue,
    xfeat_lighterglue,
)
from mkpc_kaggle.matchers.adapters.aliked import aliked_encoder
from mkpc_kaggle.matchers.adapters.loma import LomaAdapter, LomaOptions
from mkpc_kaggle.matchers.adapters.superglue import SuperGlueMatcher
from mkpc_kaggle.matchers.contract import Colour, Picture, Placement
from mkpc_kaggle.matchers.dense import DenseMatcher, DenseOptions
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.lightglue import LightGlue, LightGlueShape
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.matchers.registry import spec_of
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher
from mkpc_kaggle.matchers.sparse import Encode
from tests.support.standin import filled, narrow_roma, scene

SIZE = Size(96, 64)
SHIFT = 8  # pixels between the two pictures of a pair


# Filling a network takes long, and no test changes this one: each matcher gets a copy.
@cache
def standin(
    name: str, make: Callable[..., nn.Module], *settings: Any, **named: Any
) -> nn.Module:
    return filled(make(*settings, **named), name)


def ours(placement: Placement, *network: Any, **named: Any) -> Any:
    return prepared(unprepared(*network, **named), placement)


def unprepared(*network: Any, **named: Any) -> Any:
    """A network that its matcher prepares."""
    return copy.deepcopy(standin(*network, **named))


def superglue_matcher(placement: Placement, keypoints: int = 200) -> SuperGlueMatcher:
    superpoint = ours(placement, "superpoint", SuperPoint, max_keypoints=keypoints)
    return SuperGlueMatcher(
        superpoint, ours(placement, "superglue", SuperGlue), placement.device
    )


def semi_dense_matcher(name, make, placement):
    return SemiDenseMatcher(
        ours(placement, name, make), spec_of(name, "test"), placement.device
    )


def dkm_matcher(placement: Placement, matches: int = 300) -> DenseMatcher:
    options = DenseOptions(matches=matches)
    return DenseMatcher(dkm.SPEC, ours(placement, "dkm", DKM), options, placement.device)


def roma_matcher(placement: Placement) -> DenseMatcher:
    network = ours(placement, "roma", narrow_roma)
    options = roma.RomaOptions(matches=300)
    return DenseMatcher(roma.SPEC, network, options, placement.device, multiple=14)


def loma_matcher(placement: Placement) -> LomaAdapter:
    options = LomaOptions(Variant.B128, max_keypoints=200, threshold=0.0)
    return LomaAdapter(ours(placement, "loma", Loma, Variant.B128), options, placement.device)


def aliked_matcher(placement: Placement, keypoints: int = 200) -> NeighbourMatcher:
    return NeighbourMatcher(aliked.SPEC, aliked_keypoints(placement, keypoints)[0], ratio=1.0)


Keypoints = tuple[Encode, LightGlueShape]  # and the shape of LightGlue for them


def aliked_keypoints(placement: Placement, keypoints: int) -> Keypoints:
    network = unprepared("aliked", Aliked, keypoints)
    return aliked_encoder(network, placement), aliked_lightglue.SHAPE


def sift_keypoints(placement: Placement, keypoints: int) -> Keypoints:
    return sift_lightglue.sift_encoder(keypoints, placement.device), sift_lightglue.SHAPE


def xfeat_keypoints(placement: Placement, keypoints: int) -> Keypoints:
    network = xfeat_lighterglue.xfeat_network(keypoints)
    # Weights that were never trained detect nothing above the published threshold.
    network.detection_threshold = 0.0
    network.net = filled(network.net, "xfeat")
    return xfeat_lighterglue.xfeat_encoder(
        network, keypoints, placement
    ), xfeat_lighterglue.SHAPE


KEYPOINTS = {
    "aliked_lightglue": aliked_keypoints,
    "sift_lightglue": sift_keypoints,
    "xfeat_lighterglue": xfeat_keypoints,
}


def lightglue_matcher(
    name: str,
    placement: Placement,
    keypoints: int = 200,
    layers: int = 2,
    threshold: float = 0.0,
) -> LightGlueMatcher:
    encode, shape = KEYPOINTS[name](placement, keypoints)
    # All layers and keypoints: what untrained weights would drop is chance.
    network = unprepared(
        "lightglue", LightGlue, replace(shape, layers=layers), -1, -1, threshold
    )
    return LightGlueMatcher(spec_of(name, "test"), encode, network, placement)


MATCHERS: dict[str, Callable[..., Any]] = {
    "superglue": superglue_matcher,
    "loftr": partial(semi_dense_matcher, "loftr", Loftr),
    "quadtree": partial(semi_dense_matcher, "quadtree", Quadtree),
    "aspanformer": partial(semi_dense_matcher, "aspanformer", AspanFormer),
    "dkm": dkm_matcher,
    "roma": roma_matcher,
    "loma": loma_matcher,
    "aliked": aliked_matcher,
    **{name: partial(lightglue_matcher, name) for name in KEYPOINTS},
}


def picture(colour: Colour, number: int, shift: int = 0) -> Picture:
    """A part of the scene of that number, which begins up to SHIFT pixels further right."""
    channels = 1 if colour is Colour.GRAY else 3
    whole = scene(SIZE.height, SIZE.width + SHIFT, channels, name=f"picture {number}")
    part = whole[:, shift:][:, : SIZE.width]
    pixels = np.ascontiguousarray(part[..., 0] if colour is Colour.GRAY else part)
    return Picture(pixels, View(Box.whole(SIZE), SIZE, SIZE))
