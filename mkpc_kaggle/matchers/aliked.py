"""ALIKED keypoints (Zhao et al. 2023) with mutual nearest neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.neighbours import mutual_neighbours
from mkpc_kaggle.matchers.networks.aliked import Aliked, own_name
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.sparse import Keypoints, image_batch, matches_of
from mkpc_kaggle.weights import WeightStore, load_into

SLOT = "aliked-n16"


@dataclass(frozen=True)
class AlikedOptions:
    """``features``: the strongest kept in each picture. ``ratio`` of 1 leaves the mutual test alone."""

    features: int = 2048
    ratio: float = 1.0

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


class AlikedEncoder:
    """Keypoints of one picture, for every matcher of ALIKED's keypoints."""

    def __init__(self, network: Aliked, device: str) -> None:
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        if not pictures:
            return []
        found = self._network(image_batch(list(pictures), self.device))
        return [
            Keypoints.on_content(keypoints.points, keypoints.descriptors, picture.content)
            for keypoints, picture in zip(found, pictures, strict=True)
        ]


class AlikedMatcher:
    """A match's score is the cosine of its descriptors."""

    spec = SPEC

    def __init__(self, encoder: AlikedEncoder, options: AlikedOptions) -> None:
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


def load_encoder(weights: WeightStore, features: int, placement: Placement) -> AlikedEncoder:
    network = Aliked(max_keypoints=features)
    tensors = {own_name(name): tensor for name, tensor in weights.load(SLOT).items()}
    load_into(network, tensors, what=SLOT)
    return AlikedEncoder(placed(network, placement), placement.device)


def load(weights: WeightStore, options: AlikedOptions, placement: Placement) -> AlikedMatcher:
    return AlikedMatcher(load_encoder(weights, options.features, placement), options)
