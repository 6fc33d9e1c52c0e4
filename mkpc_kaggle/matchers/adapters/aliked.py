"""ALIKED keypoints (Zhao et al. 2023, kornia's network) with mutual nearest neighbours."""

from kornia.feature import ALIKED
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher
from mkpc_kaggle.matchers.sparse import Encode, KeypointOptions, keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SLOT = "aliked-n16"
SPEC = MatcherSpec("aliked", KeypointOptions, multiple=32, slots=(SLOT,))


class AlikedMatcher(NeighbourMatcher):
    """ALIKED; a match's score is the cosine of its two descriptors."""

    spec = SPEC

    def __init__(self, encode: Encode) -> None:
        self.encode = encode


def aliked_network(features: int) -> ALIKED:
    return ALIKED(SLOT, max_num_keypoints=features, detection_threshold=0.0)  # keypoints of any score


def aliked_encoder(network: ALIKED, placement: Placement) -> Encode:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [(each.keypoints, each.descriptors) for each in network(images)]

    in_float32 = Placement(placement.device)  # half precision changes three quarters of the keypoints
    return keypoint_encoder(network, network.score_head, detect, in_float32)


def load_encoder(weights: WeightStore, features: int, placement: Placement) -> Encode:
    """Load ALIKED's encoder, which all matchers of ALIKED keypoints share."""
    network = aliked_network(features)
    load_into(network, weights.load(SLOT), unused=r"dkd\.hw_grid", what=SLOT)  # a constant
    return aliked_encoder(network, placement)


def load(weights: WeightStore, options: KeypointOptions, placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(load_encoder(weights, options.features, placement))
