"""All matchers of learned features in light configurations, with stand-in weights and no files.

A new matcher is one line in ``MATCHERS``.
"""

import copy
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from kornia.feature import DISK, XFeat
from roma_values import NARROW
from standin import filled, scene
from torch import nn

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers import (
    aliked_lightglue,
    aspanformer,
    disk_lightglue,
    dkm,
    loftr,
    quadtree,
    xfeat_lighterglue,
)
from mkpc_kaggle.matchers.aliked import AlikedEncoder, AlikedMatcher, AlikedOptions
from mkpc_kaggle.matchers.contract import Colour, Picture, Placement
from mkpc_kaggle.matchers.dkm import DkmMatcher, DkmOptions
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, light_glue
from mkpc_kaggle.matchers.loma import LomaAdapter, LomaOptions
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.matchers.networks.superglue import SuperGlue, SuperGlueConfig
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointConfig
from mkpc_kaggle.matchers.roma import RomaMatcher, RomaOptions
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher
from mkpc_kaggle.matchers.superglue import SuperGlueMatcher

SIZE = Size(96, 64)
SHIFT = 8  # pixels between the two pictures of a pair
KEYPOINTS = LightGlueOptions(features=200, threshold=0.0)


@cache
def standin(name: str, make: Callable[[], nn.Module]) -> nn.Module:
    return filled(make(), name)


def ours(name: str, make: Callable[[], nn.Module], placement: Placement) -> Any:
    """One of our networks, made ready to run there."""
    return placed(copy.deepcopy(standin(name, make)), placement)


def kornias(name: str, make: Callable[[], nn.Module]) -> Any:
    """One of kornia's, which its matcher will move."""
    return copy.deepcopy(standin(name, make))


def make_superpoint() -> SuperPoint:
    return SuperPoint(SuperPointConfig(max_keypoints=200)).eval()


def make_superglue() -> SuperGlue:
    return SuperGlue(SuperGlueConfig(20))


def superglue_matcher(placement: Placement) -> SuperGlueMatcher:
    superpoint = ours("superpoint", make_superpoint, placement)
    return SuperGlueMatcher(superpoint, ours("superglue", make_superglue, placement), placement.device)


def semi_dense_matcher(module: Any, make: Callable[[], nn.Module]) -> Callable[[Placement], SemiDenseMatcher]:
    spec = module.SPEC
    return lambda placement: SemiDenseMatcher(ours(spec.name, make, placement), spec, placement.device)


def dkm_matcher(passes: int) -> Callable[[Placement], DkmMatcher]:
    options = DkmOptions(passes=passes, matches=300)
    return lambda placement: DkmMatcher(ours("dkm", DKM, placement), options, placement.device)


def make_roma() -> RoMa:
    return RoMa(NARROW)


def roma_matcher(placement: Placement) -> RomaMatcher:
    return RomaMatcher(ours("roma", make_roma, placement), RomaOptions(matches=300), placement.device)


def make_loma() -> Loma:
    return Loma(Variant.B128)


def loma_matcher(placement: Placement) -> LomaAdapter:
    options = LomaOptions(Variant.B128, max_keypoints=200, match_threshold=0.0)
    return LomaAdapter(ours("loma", make_loma, placement), options, placement.device)


def make_aliked() -> Aliked:
    return Aliked(max_keypoints=KEYPOINTS.features)


def aliked_encoder(placement: Placement) -> AlikedEncoder:
    return AlikedEncoder(ours("aliked", make_aliked, placement), placement.device)


def aliked_matcher(placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(aliked_encoder(placement), AlikedOptions())


def make_glue() -> nn.Module:
    return light_glue(2, KEYPOINTS.threshold, input_dim=128)


def aliked_lightglue_matcher(placement: Placement) -> LightGlueMatcher:
    glue = kornias("lightglue", make_glue)
    return LightGlueMatcher(aliked_lightglue.SPEC, aliked_encoder(placement), glue, KEYPOINTS, placement)


def disk_lightglue_matcher(placement: Placement) -> LightGlueMatcher:
    encoder = disk_lightglue.DiskEncoder(kornias("disk", DISK), KEYPOINTS.features, placement)
    glue = kornias("lightglue", make_glue)
    return LightGlueMatcher(disk_lightglue.SPEC, encoder, glue, KEYPOINTS, placement)


def make_xfeat() -> nn.Module:
    return XFeat().net


def make_lighter_glue() -> nn.Module:
    return light_glue(2, KEYPOINTS.threshold, **xfeat_lighterglue.SHAPE)


def xfeat_lighterglue_matcher(placement: Placement) -> LightGlueMatcher:
    network = XFeat(detection_threshold=0.0)
    network.net = kornias("xfeat", make_xfeat)
    encoder = xfeat_lighterglue.XFeatEncoder(network, KEYPOINTS.features, placement)
    glue = kornias("lightglue", make_lighter_glue)
    return LightGlueMatcher(xfeat_lighterglue.SPEC, encoder, glue, KEYPOINTS, placement)


MATCHERS: dict[str, Callable[[Placement], Any]] = {
    "superglue": superglue_matcher,
    "loftr": semi_dense_matcher(loftr, Loftr),
    "quadtree": semi_dense_matcher(quadtree, Quadtree),
    "aspanformer": semi_dense_matcher(aspanformer, AspanFormer),
    dkm.SPEC.name: dkm_matcher(1),
    "dkm, two passes": dkm_matcher(2),
    "roma": roma_matcher,
    "loma": loma_matcher,
    "aliked": aliked_matcher,
    "aliked_lightglue": aliked_lightglue_matcher,
    "disk_lightglue": disk_lightglue_matcher,
    "xfeat_lighterglue": xfeat_lighterglue_matcher,
}


def picture(colour: Colour, number: int, shift: int = 0) -> Picture:
    """A part of the scene of that number, which begins up to SHIFT pixels further right."""
    channels = 1 if colour is Colour.GRAY else 3
    whole = scene(SIZE.height, SIZE.width + SHIFT, channels, name=f"picture {number}")
    part = whole[:, shift:][:, : SIZE.width]
    pixels = np.ascontiguousarray(part[..., 0] if colour is Colour.GRAY else part)
    return Picture(pixels, View(Box.whole(SIZE), SIZE, SIZE))
