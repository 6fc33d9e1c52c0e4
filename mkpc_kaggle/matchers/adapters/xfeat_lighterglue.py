"""XFeat keypoints matched by LighterGlue (Potje et al. 2024; kornia's networks)."""

from kornia.feature import XFeat
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, load_lightglue
from mkpc_kaggle.matchers.sparse import Encode, KeypointOptions, keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SHAPE = {"input_dim": 64, "descriptor_dim": 96, "num_heads": 1}  # a narrow LightGlue
SPEC = MatcherSpec("xfeat_lighterglue", KeypointOptions, multiple=32, slots=("xfeat", "xfeat-lighterglue"))


def xfeat_encoder(network: XFeat, features: int, placement: Placement) -> Encode:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        found = network.detectAndCompute(images, top_k=features)
        return [(each["keypoints"], each["descriptors"]) for each in found]

    return keypoint_encoder(network, network.net, detect, placement)


def load(weights: WeightStore, options: KeypointOptions, placement: Placement) -> LightGlueMatcher:
    network = XFeat(top_k=options.features)
    # The fine matcher is for semi-dense matching only; some checkpoints do not have it.
    load_into(network.net, weights.load("xfeat"), unused=r"fine_matcher\.", what="xfeat")
    encode = xfeat_encoder(network, options.features, placement)
    return load_lightglue(SPEC, encode, weights, placement, **SHAPE)
