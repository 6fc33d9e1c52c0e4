"""ALIKED keypoints (Zhao et al. 2023) with mutual nearest neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.neighbours import mutual_neighbours
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.sparse import KeypointEncoder, Keypoints, matches_of
from mkpc_kaggle.weights import WeightStore, load_into

SLOT = "aliked-n16"


@dataclass(frozen=True)
class AlikedOptions:
    features: int = 2048  # the strongest kept in each picture
    ratio: float = 1.0  # of the distances to the nearest and second nearest descriptor, at most; 1: no ratio test

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1, ratio=SHARE)


SPEC = MatcherSpec(
    "aliked",
    "ALIKED n16, mutual nearest neighbours",
    AlikedOptions,
    multiple=32,
    licences=("BSD-3-Clause",),
    slots=(SLOT,),
)


class AlikedMatcher:
    """A match's score is the cosine of its descriptors."""

    spec = SPEC

    def __init__(self, encoder: KeypointEncoder, options: AlikedOptions) -> None:
        self.options = options
        self.encode = encoder.encode

    @torch.inference_mode()
    def match(self, encodings0: Sequence[Keypoints], encodings1: Sequence[Keypoints]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, keypoints0: Keypoints, keypoints1: Keypoints) -> Matches:
        pairs = mutual_neighbours(keypoints0.descriptors, keypoints1.descriptors)
        passed = pairs.ratio <= self.options.ratio
        return matches_of(
            keypoints0, keypoints1, pairs.index0[passed], pairs.index1[passed], pairs.similarity[passed]
        )


def load_encoder(weights: WeightStore, features: int, placement: Placement) -> KeypointEncoder:
    """ALIKED's, for every matcher of its keypoints."""
    network = Aliked(features)
    load_into(network, {own_name(name): tensor for name, tensor in weights.load(SLOT).items()}, what=SLOT)
    return KeypointEncoder(placed(network, placement), placement.device)


def load(weights: WeightStore, options: AlikedOptions, placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(load_encoder(weights, options.features, placement), options)
