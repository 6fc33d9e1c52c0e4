"""XFeat keypoints matched by LighterGlue (Potje et al. 2024; kornia's networks)."""

from collections.abc import Iterator

from kornia.feature import XFeat
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dtypes import check_results
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.sparse import KeypointEncoder
from mkpc_kaggle.weights import WeightStore, load_into

XFEAT, LIGHTERGLUE = "xfeat", "xfeat-lighterglue"
SHAPE = {"input_dim": 64, "descriptor_dim": 96, "num_heads": 1}  # LighterGlue is a narrow LightGlue
SPEC = MatcherSpec(
    "xfeat_lighterglue",
    "XFeat with LighterGlue: fast, learned",
    LightGlueOptions,
    multiple=32,
    licences=("Apache-2.0",),
    slots=(XFEAT, LIGHTERGLUE),
)


def xfeat_encoder(network: XFeat, features: int, placement: Placement) -> KeypointEncoder:
    network.eval().to(placement.device)
    check_results("features of xfeat", network.net)

    def detect(images: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        with autocast(placement):
            found = network.detectAndCompute(images, top_k=features)
        return ((each["keypoints"], each["descriptors"]) for each in found)

    return KeypointEncoder(detect, placement.device)


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = XFeat(top_k=options.features)
    # Its fine matcher serves semi-dense matching only; some checkpoints are without it.
    load_into(network.net, weights.load(XFEAT), unused=r"fine_matcher\.", what=XFEAT)
    glue = load_glue(weights, LIGHTERGLUE, options.threshold, **SHAPE)
    return LightGlueMatcher(SPEC, xfeat_encoder(network, options.features, placement), glue, placement)
