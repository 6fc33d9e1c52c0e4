"""The adapter of dense networks, which encodes each picture and samples matches from a pair's warps."""

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import torch

from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseFeatures, DenseNetwork
from mkpc_kaggle.matchers.networks.pixels import network_input

THRESHOLD = 0.05  # certainties above it count as 1, as published
MIN_SIDE_PX = 8  # of the images in the second pass


class DenseEncoding(NamedTuple):
    """A picture's features, the size of its content, and a checksum of its pixels."""

    features: DenseFeatures
    content: Size
    checksum: int


class DenseMatcher(PairwiseMatcher[DenseEncoding]):
    """A dense matcher. A match's score is its certainty; the random seed depends on the two pictures alone.

    Pictures and pairs are processed one by one, so that results do not depend on the batch. ``first_pass``
    scales the first of two passes; None means one pass. Sides in the first pass are multiples of ``multiple``.
    """

    matches = 5000  # the maximum per pair

    def __init__(
        self,
        spec: MatcherSpec,
        network: DenseNetwork,
        device: str,
        *,
        multiple: int = 1,
        first_pass: float | None = None,
    ) -> None:
        self.spec, self.device = spec, device
        self._network, self._multiple, self._first_pass = network, multiple, first_pass

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[DenseEncoding]:
        return [self._encode(picture) for picture in pictures]

    def _encode(self, picture: Picture) -> DenseEncoding:
        width, height = picture.content
        # The network accepts any size, so padding is cut off.
        content = picture.pixels[:height, :width].copy()
        pixels = torch.from_numpy(content).permute(2, 0, 1)[None]  # (1, 3, H, W)
        share, multiple = self._first_pass or 1, self._multiple
        rows, columns = (multiple * max(1, round(side * share / multiple)) for side in (height, width))
        first = network_input(pixels, (rows, columns)).to(self.device)
        second = None
        if self._first_pass:
            size = max(MIN_SIDE_PX, height), max(MIN_SIDE_PX, width)
            second = network_input(pixels, size).to(self.device)
        return DenseEncoding(self._network.encode(first, second), picture.content, zlib.crc32(content.data))

    def _match(self, first: DenseEncoding, second: DenseEncoding) -> Matches:
        warps = self._network.match(first.features, second.features)
        warp = torch.cat([dense.warp.reshape(-1, 4) for dense in warps])
        certainty = torch.cat([dense.certainty.flatten() for dense in warps])
        check_finite(f"certainties of {self.spec.name}", certainty, warp)
        # PyTorch's CPU generator uses 32 bits of a seed, so the two checksums are combined into 32 bits.
        seed = zlib.crc32(second.checksum.to_bytes(4), first.checksum)
        generator = torch.Generator(warp.device).manual_seed(seed)
        index = sample_matches(warp, certainty, self.matches, THRESHOLD, generator)
        points = warp[index].cpu().numpy()
        return Matches(
            from_normalised(points[:, :2], first.content),
            from_normalised(points[:, 2:], second.content),
            certainty[index].cpu().numpy(),
        )
