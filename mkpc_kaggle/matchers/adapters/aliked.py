"""ALIKED keypoints (Zhao et al. 2023) with mutual nearest neighbours."""

from dataclasses import dataclass
from enum import StrEnum

from mkpc_kaggle.config import SHARE, check_ranges
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement, Precision
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.sparse import Encode, KeypointOptions, keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into


class AlikedVariant(StrEnum):
    """The published networks with 128 channels; n16rot was trained with rotated images."""

    N16 = "n16"
    N16ROT = "n16rot"
    N32 = "n32"


SLOT = "aliked-{variant}"


@dataclass(frozen=True)
class AlikedOptions(KeypointOptions):
    """``ratio``: the maximum ratio of the distances to the two nearest neighbours; 1: any."""

    variant: AlikedVariant = AlikedVariant.N16
    ratio: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, ratio=SHARE)


SPEC = MatcherSpec("aliked", AlikedOptions, multiple=32, slots=(SLOT,))


def load_encoder(
    weights: WeightStore, features: int, variant: AlikedVariant, placement: Placement
) -> Encode:
    """Load ALIKED's encoder, which all matchers of ALIKED keypoints share."""
    slot = SLOT.format(variant=variant)
    network = Aliked(features, positions=32 if variant is AlikedVariant.N32 else 16)
    tensors = {own_name(name): tensor for name, tensor in weights.load(slot).items()}
    load_into(network, tensors, what=slot)
    return aliked_encoder(network, placement)


def aliked_encoder(network: Aliked, placement: Placement) -> Encode:
    """Return the encoder of a loaded network."""
    # Float32 in any precision: in half precision three quarters of the keypoints change.
    in_float32 = Placement(placement.device, Precision.FLOAT32)
    return keypoint_encoder(prepared(network, in_float32), in_float32)


def load(
    weights: WeightStore, options: AlikedOptions, placement: Placement
) -> NeighbourMatcher:
    encode = load_encoder(weights, options.features, options.variant, placement)
    return NeighbourMatcher(SPEC, encode, options.ratio)
