"""ALIKED keypoints (Zhao et al. 2023) with mutual nearest neighbours."""

from dataclasses import dataclass

from mkpc_kaggle.config import AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.sparse import KeypointEncoder
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


def load_encoder(weights: WeightStore, features: int, placement: Placement) -> KeypointEncoder:
    """Load ALIKED's encoder, for all matchers of its keypoints."""
    network = Aliked(features)
    load_into(network, {own_name(name): tensor for name, tensor in weights.load(SLOT).items()}, what=SLOT)
    return KeypointEncoder(prepared(network, placement), placement.device)


def load(weights: WeightStore, options: AlikedOptions, placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(load_encoder(weights, options.features, placement), options)
