"""The adapter of semi-dense networks: it encodes pictures, and matches a pair's coarse cells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mkpc_kaggle.config import SHARE, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_corner
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import (
    Colour,
    MatcherSpec,
    PairwiseMatcher,
    Picture,
    Placement,
    TrainedOptions,
    Training,
)
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.resnet_fpn import FeatureMaps
from mkpc_kaggle.matchers.networks.semi_dense import SemiDenseNetwork
from mkpc_kaggle.matchers.sparse import image_batch
from mkpc_kaggle.weights import WeightStore, load_into

PREFIX = "matcher."  # of parameter names in the published training checkpoints
# The network computes positions, and the published ASpanFormer does not use its offsets.
UNUSED = r".*(pos_encoding\.pe|\.sample_offset)$"


@dataclass(frozen=True)
class SemiDenseOptions(TrainedOptions):
    """The options of a semi-dense matcher, with the defaults of the published evaluations."""

    threshold: float = 0.2  # the minimum confidence of a match, after the dual softmax

    def __post_init__(self) -> None:
        check_ranges(self, threshold=SHARE)


class SemiDenseEncoding(NamedTuple):
    """A picture's feature maps, as a batch of one, and the size of its content."""

    maps: FeatureMaps
    content: Size

    @property
    def mask(self) -> Tensor:
        """(1, h, w) bool, True for the coarse cells whose top-left pixel is content."""
        height, width = self.maps.coarse.shape[2:]
        device = self.maps.coarse.device
        # As published, the mask of the pixels is read at each cell's first pixel.
        rows = torch.arange(height, device=device) * COARSE_STRIDE < self.content.height
        columns = torch.arange(width, device=device) * COARSE_STRIDE < self.content.width
        return (rows[:, None] & columns)[None]


class SemiDenseMatcher(PairwiseMatcher[SemiDenseEncoding]):
    """A semi-dense matcher; a match's score is the confidence of its pair of coarse cells."""

    def __init__(self, network: SemiDenseNetwork, spec: MatcherSpec, device: str) -> None:
        self.spec = spec
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[SemiDenseEncoding]:
        maps = self._network.encode(image_batch(pictures, self.device))
        encodings = []
        for index, picture in enumerate(pictures):
            # Copies: a view would keep the whole batch in memory.
            coarse = maps.coarse[index : index + 1].clone()
            fine = maps.fine[index : index + 1].clone()
            encodings.append(SemiDenseEncoding(FeatureMaps(coarse, fine), picture.content))
        return encodings

    def _match(self, first: SemiDenseEncoding, second: SemiDenseEncoding) -> Matches:
        masks = (first.mask, second.mask)
        # No masks for pictures without padding: even a mask that is True everywhere can change
        # rounding.
        is_whole = bool(masks[0].all() and masks[1].all())
        found = self._network.match(first.maps, second.maps, None if is_whole else masks)
        # The networks count pixels from the image's corner.
        points0 = from_corner(found.points0.float().cpu().numpy())
        points1 = from_corner(found.points1.float().cpu().numpy())
        return Matches(points0, points1, found.coarse.scores.float().cpu().numpy())


def semi_dense_spec(name: str, multiple: int) -> MatcherSpec:
    """Return the spec of a network with weights for outdoors and indoors."""
    return MatcherSpec(
        name, SemiDenseOptions, Colour.GRAY, multiple, (f"{name}-{{training}}",)
    )


def load_semi_dense(
    spec: MatcherSpec,
    make: Callable[[Training], SemiDenseNetwork],
    weights: WeightStore,
    options: SemiDenseOptions,
    placement: Placement,
) -> SemiDenseMatcher:
    """Load the published checkpoint into a network from ``make``."""
    (slot,) = spec.slots_for(options)
    tensors = {
        name.removeprefix(PREFIX): tensor for name, tensor in weights.load(slot).items()
    }
    network = make(options.training)
    load_into(network, tensors, what=slot, unused=UNUSED)
    network.threshold = options.threshold
    return SemiDenseMatcher(prepared(network, placement), spec, placement.device)
