"""XFeat keypoints matched by LighterGlue (Potje et al. 2024; kornia's networks)."""

from collections.abc import Sequence

import torch
from kornia.feature import XFeat

from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.numbers import check_results
from mkpc_kaggle.matchers.sparse import Keypoints, image_batch
from mkpc_kaggle.weights import WeightStore, load_into

XFEAT, LIGHTERGLUE = "xfeat", "xfeat-lighterglue"
SHAPE = {"input_dim": 64, "descriptor_dim": 96, "num_heads": 1}
"""LighterGlue is a narrow LightGlue."""
SPEC = MatcherSpec(
    "xfeat_lighterglue",
    "XFeat with LighterGlue: fast, learned",
    LightGlueOptions,
    multiple=32,
    licences=("Apache-2.0",),
    slots=(XFEAT, LIGHTERGLUE),
)


class XFeatEncoder:
    def __init__(self, network: XFeat, features: int, placement: Placement) -> None:
        self._network = network.eval().to(placement.device)
        check_results("features of xfeat", network.net)
        self._features = features
        self._placement = placement

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        batch = image_batch(list(pictures), self._placement.device)
        with autocast(self._placement):
            found = self._network.detectAndCompute(batch, top_k=self._features)
        return [
            Keypoints.on_content(features["keypoints"], features["descriptors"], picture.content)
            for features, picture in zip(found, pictures, strict=True)
        ]


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = XFeat(top_k=options.features)
    # Its fine matcher serves semi-dense matching only; some checkpoints are without it.
    load_into(network.net, weights.load(XFEAT), unused=r"fine_matcher\.", what=XFEAT)
    glue = load_glue(weights, LIGHTERGLUE, options.threshold, **SHAPE)
    return LightGlueMatcher(SPEC, XFeatEncoder(network, options.features, placement), glue, options, placement)
