"""ALIKED keypoints (Zhao et al. 2023, kornia's network) with mutual nearest neighbours."""

from dataclasses import dataclass

from kornia.feature import ALIKED
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher
from mkpc_kaggle.matchers.sparse import KeypointEncoder, library_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SLOT = "aliked-n16"


@dataclass(frozen=True)
class AlikedOptions:
    features: int = 2048  # the number of strongest keypoints per picture
    ratio: float = 1.0  # maximum ratio of the two smallest distances; 1: no ratio test

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1, ratio=SHARE)


SPEC = MatcherSpec("aliked", AlikedOptions, multiple=32, slots=(SLOT,))


class AlikedMatcher(NeighbourMatcher):
    """ALIKED; a match's score is the cosine of its descriptors."""

    spec = SPEC

    def __init__(self, encoder: KeypointEncoder, options: AlikedOptions) -> None:
        self.ratio = options.ratio
        self.encode = encoder.encode


def aliked_network(features: int) -> ALIKED:
    return ALIKED(SLOT, max_num_keypoints=features, detection_threshold=0.0)  # of any score


def aliked_encoder(network: ALIKED, placement: Placement) -> KeypointEncoder:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [(each.keypoints, each.descriptors) for each in network(images)]

    in_float32 = Placement(placement.device)  # half precision changes three quarters of the keypoints
    return library_encoder(network, network.score_head, detect, in_float32)


def load_encoder(weights: WeightStore, features: int, placement: Placement) -> KeypointEncoder:
    """Load ALIKED's encoder, for all matchers of its keypoints."""
    network = aliked_network(features)
    load_into(network, weights.load(SLOT), unused=r"dkd\.hw_grid", what=SLOT)  # a constant
    return aliked_encoder(network, placement)


def load(weights: WeightStore, options: AlikedOptions, placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(load_encoder(weights, options.features, placement), options)
