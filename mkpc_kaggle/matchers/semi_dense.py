"""The adapter of the semi-dense networks: backbone maps once a picture, matches of coarse cells for a pair."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mkpc_kaggle.geometry.coordinates import Size, from_corner
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Training
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE, SemiDenseMatches
from mkpc_kaggle.matchers.networks.resnet_fpn import FeatureMaps
from mkpc_kaggle.matchers.networks.semi_dense import SemiDenseNetwork
from mkpc_kaggle.matchers.sparse import image_batch
from mkpc_kaggle.ranges import SHARE, check_ranges
from mkpc_kaggle.weights import WeightStore, load_into

PREFIX = "matcher."
"""Of every parameter's name in the published training checkpoints."""


@dataclass(frozen=True)
class SemiDenseOptions:
    """``threshold``: matches must be surer than this."""

    threshold: float = 0.2
    training: Training = Training.OUTDOOR

    def __post_init__(self) -> None:
        check_ranges(self, threshold=SHARE)


@dataclass(frozen=True, eq=False)
class Encoded:
    """A picture's feature maps, a batch of one, and the size of its content."""

    maps: FeatureMaps
    content: Size


class SemiDenseMatcher:
    """A match's score is the confidence of its coarse cells."""

    def __init__(self, network: SemiDenseNetwork[Any], spec: MatcherSpec, device: str) -> None:
        self.spec = spec
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Encoded]:
        if not pictures:
            return []
        maps = self._network.encode(image_batch(list(pictures), self.device))
        singles = zip(torch.split(maps.coarse, 1), torch.split(maps.fine, 1), strict=True)
        return [
            Encoded(FeatureMaps(*single), picture.content)
            for single, picture in zip(singles, pictures, strict=True)
        ]

    @torch.inference_mode()
    def match(self, encodings0: Sequence[Encoded], encodings1: Sequence[Encoded]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, encoded0: Encoded, encoded1: Encoded) -> Matches:
        masks = content_mask(encoded0), content_mask(encoded1)
        padded = not all(bool(mask.all()) for mask in masks)
        return to_matches(self._network.match(encoded0.maps, encoded1.maps, masks if padded else None))


def content_mask(encoded: Encoded) -> Tensor:
    """(1, h, w) bool, True for the coarse cells whose top-left pixel is content."""
    height, width = encoded.maps.coarse.shape[2:]
    rows, columns = (
        torch.arange(count, device=encoded.maps.coarse.device) * COARSE_STRIDE < side
        for count, side in ((height, encoded.content.height), (width, encoded.content.width))
    )
    return (rows[:, None] & columns)[None]


def to_matches(found: SemiDenseMatches) -> Matches:
    """Matches in view pixels."""
    points0, points1 = (from_corner(points.float().cpu().numpy()) for points in (found.points0, found.points1))
    return Matches(points0, points1, found.coarse.confidence.float().cpu().numpy())


def load_network(network: SemiDenseNetwork[Any], weights: WeightStore, slot: str, *, unused: str = "$^") -> None:
    """Fill a network from the published checkpoint, whose names have the training wrapper's prefix.

    Position tables, which are computed, and names that match ``unused`` are set aside.
    """
    tensors = {name.removeprefix(PREFIX): tensor for name, tensor in weights.load(slot).items()}
    load_into(network, tensors, what=slot, unused=rf".*pos_encoding\.pe$|{unused}")
