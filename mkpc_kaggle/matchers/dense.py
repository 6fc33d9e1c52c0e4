"""The adapter of dense networks: features of each picture, matches sampled from the warps of a pair."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch

from mkpc_kaggle.config import AT_LEAST_1, SHARE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture, Training
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseFeatures, DenseNetwork
from mkpc_kaggle.matchers.networks.pixels import network_input


@dataclass(frozen=True)
class DenseOptions:
    passes: int = 1  # 2: on pictures scaled by ``first_pass``, then on full ones
    first_pass: float = 0.625
    matches: int = 5000  # at most
    threshold: float = 0.05  # certainties above it count as 1
    training: Training = Training.OUTDOOR

    def __post_init__(self) -> None:
        check_ranges(self, passes=Range(1, 2), first_pass=Range(0, 1, "(]"), matches=AT_LEAST_1, threshold=SHARE)


class DenseEncoding(NamedTuple):
    """A picture's features, the size of its content, and a checksum of its pixels."""

    features: DenseFeatures
    content: Size
    checksum: int


class DenseMatcher(PairwiseMatcher[DenseEncoding]):
    """A dense matcher. A match's score is its certainty; sampling depends on the two pictures alone.

    Pictures and pairs are processed one by one, so that results do not depend on the batch. ``multiple``: sides in
    the first pass are multiples of it; ``min_side_px``: the shortest side of any image.
    """

    spec: ClassVar[MatcherSpec]
    multiple: ClassVar[int] = 1
    min_side_px: ClassVar[int] = 1

    def __init__(self, network: DenseNetwork, options: DenseOptions, device: str) -> None:
        self.options = options
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[DenseEncoding]:
        return [self._encode(picture) for picture in pictures]

    def _encode(self, picture: Picture) -> DenseEncoding:
        width, height = picture.content
        # The network accepts any size, so padding is cut off.
        content = picture.pixels[:height, :width].copy()
        pixels = torch.from_numpy(content).permute(2, 0, 1)[None]  # (1, 3, H, W)
        first = network_input(pixels, self._first_size(picture.content)).to(self.device)
        second = None
        if self.options.passes == 2:
            size = max(self.min_side_px, height), max(self.min_side_px, width)
            second = network_input(pixels, size).to(self.device)
        return DenseEncoding(self._network.encode(first, second), picture.content, zlib.crc32(content.data))

    def _first_size(self, content: Size) -> tuple[int, int]:
        """Return (H, W) of the first pass's image."""
        share = self.options.first_pass if self.options.passes == 2 else 1
        width, height = (self.multiple * max(1, round(side * share / self.multiple)) for side in content)
        return height, width

    def _match(self, first: DenseEncoding, second: DenseEncoding) -> Matches:
        options = self.options
        warps = self._network.match(first.features, second.features)
        warp = torch.cat([dense.warp.reshape(-1, 4) for dense in warps])
        certainty = torch.cat([dense.certainty.flatten() for dense in warps])
        check_finite(f"certainties of {self.spec.name}", certainty, warp)
        # PyTorch's CPU generator uses 32 bits of a seed, so both checksums become one of 32 bits.
        seed = zlib.crc32(second.checksum.to_bytes(4), first.checksum)
        generator = torch.Generator(warp.device).manual_seed(seed)
        index = sample_matches(warp, certainty, options.matches, options.threshold, generator)
        points = warp[index].cpu().numpy()
        return Matches(
            from_normalised(points[:, :2], first.content),
            from_normalised(points[:, 2:], second.content),
            certainty[index].cpu().numpy(),
        )
