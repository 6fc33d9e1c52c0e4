"""The adapter of the semi-dense networks: feature maps for each picture, matches of coarse cells for each pair."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import torch
from torch import Tensor

from mkpc_kaggle.config import SHARE, check_ranges
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size, from_corner
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Training
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE, SemiDenseMatches
from mkpc_kaggle.matchers.networks.resnet_fpn import FeatureMaps
from mkpc_kaggle.matchers.networks.semi_dense import SemiDenseNetwork
from mkpc_kaggle.matchers.sparse import image_batch
from mkpc_kaggle.weights import WeightStore, load_into

PREFIX = "matcher."
"""The prefix of parameter names in the published training checkpoints."""
TRANSPORT = "coarse_matching.bin_score"
"""Only in checkpoints of networks with optimal transport."""


@dataclass(frozen=True)
class SemiDenseOptions:
    """``threshold``: a match's confidence is above it."""

    threshold: float = 0.2
    training: Training = Training.OUTDOOR

    def __post_init__(self) -> None:
        check_ranges(self, threshold=SHARE)


@dataclass(frozen=True, eq=False)
class Encoded:
    """A picture's feature maps, a batch of one, and the size of its content."""

    maps: FeatureMaps
    content: Size

    @property
    def padded(self) -> bool:
        """Whether there are coarse cells without content."""
        height, width = self.maps.coarse.shape[2:]
        filled = (ceil(side / COARSE_STRIDE) for side in self.content)
        return (width, height) != tuple(filled)


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
        pairs = list(zip(encodings0, encodings1, strict=True))
        alike: dict[tuple[Any, ...], list[int]] = {}
        for number, pair in enumerate(pairs):
            # Even a mask that is all True can change rounding, so padded pairs get batches of their own.
            padded = any(encoded.padded for encoded in pair)
            alike.setdefault((padded, *(encoded.maps.coarse.shape for encoded in pair)), []).append(number)
        found = {
            number: matches
            for (padded, *_), numbers in alike.items()
            for number, matches in zip(numbers, self._match([pairs[n] for n in numbers], padded), strict=True)
        }
        return [found[number] for number in range(len(pairs))]

    def _match(self, pairs: list[tuple[Encoded, Encoded]], padded: bool) -> list[Matches]:
        """Pairs of one shape, in one batch."""
        side0, side1 = zip(*pairs, strict=True)
        masks = torch.cat([*map(content_mask, side0)]), torch.cat([*map(content_mask, side1)])
        found = self._network.match(stacked(side0), stacked(side1), masks if padded else None)
        return to_matches(found, len(pairs))


def stacked(encodings: Sequence[Encoded]) -> FeatureMaps:
    """Maps of one shape as one batch."""
    if len(encodings) == 1:
        return encodings[0].maps
    coarse, fine = ([getattr(one.maps, name) for one in encodings] for name in ("coarse", "fine"))
    return FeatureMaps(torch.cat(coarse), torch.cat(fine))


def content_mask(encoded: Encoded) -> Tensor:
    """(1, h, w) bool, True for the coarse cells whose top-left pixel is content."""
    height, width = encoded.maps.coarse.shape[2:]
    rows, columns = (
        torch.arange(count, device=encoded.maps.coarse.device) * COARSE_STRIDE < side
        for count, side in ((height, encoded.content.height), (width, encoded.content.width))
    )
    return (rows[:, None] & columns)[None]


def to_matches(found: SemiDenseMatches, pairs: int) -> list[Matches]:
    """The matches of each pair of the batch, in view pixels."""
    points0, points1 = (from_corner(points.float().cpu().numpy()) for points in (found.points0, found.points1))
    matches = Matches(points0, points1, found.coarse.confidence.float().cpu().numpy())
    batch = found.coarse.batch.cpu().numpy()
    return [matches[batch == pair] for pair in range(pairs)]


def load_network(network: SemiDenseNetwork[Any], weights: WeightStore, slot: str, *, unused: str = "$^") -> None:
    """Fill a network from the published checkpoint, whose names have the training wrapper's prefix.

    Position tables, which are computed, and names that match ``unused`` are ignored. Raises :class:`UserError`
    for weights that were trained with optimal transport.
    """
    tensors = {name.removeprefix(PREFIX): tensor for name, tensor in weights.load(slot).items()}
    if TRANSPORT in tensors:
        raise UserError(
            f"the weights for {slot!r} match by optimal transport, this network by dual softmax: take the file "
            "trained with it (LoFTR's are called outdoor_ds and indoor_ds_new, not outdoor_ot and indoor_ot)"
        )
    load_into(network, tensors, what=slot, unused=rf".*pos_encoding\.pe$|{unused}")
