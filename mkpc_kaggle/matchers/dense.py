"""The adapter of dense networks: it encodes pictures, and samples matches from a pair's warps."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_1, SHARE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import (
    MatcherSpec,
    PairwiseMatcher,
    Picture,
    TrainedOptions,
)
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.dense_sampling import sample_matches
from mkpc_kaggle.matchers.networks.dense_warp import DenseFeatures, DenseNetwork
from mkpc_kaggle.matchers.networks.pixels import network_input

MIN_SIDE_PX = 8  # of the images in the second pass


@dataclass(frozen=True)
class DenseOptions(TrainedOptions):
    """The options of a dense matcher, with the defaults of DKM's publication."""

    matches: int = 5000  # the maximum number of sampled matches of a pair
    threshold: float = 0.05  # certainties above it count as 1
    passes: int = 1  # 2: first on smaller pictures, then on the unit's
    first_pass: float = 0.625  # scale of the sides in the first of two passes

    def __post_init__(self) -> None:
        check_ranges(self, matches=AT_LEAST_1, threshold=SHARE, passes=Range(1, 2))
        check_ranges(self, first_pass=Range(0, 1, "(]"))

    @property
    def first_scale(self) -> float | None:
        """The scale of the first of two passes; ``None`` for one pass."""
        return self.first_pass if self.passes == 2 else None


class DenseEncoding(NamedTuple):
    """A picture's features, the size of its content, and a checksum of its pixels."""

    features: DenseFeatures
    content: Size
    checksum: int


class DenseMatcher(PairwiseMatcher[DenseEncoding]):
    """A dense matcher; a match's score is its certainty.

    The random seed depends on the two pictures alone. Pictures and pairs are processed one by one,
    so that results do not depend on the batch. Sides in the first pass are multiples of
    ``multiple``.
    """

    def __init__(
        self,
        spec: MatcherSpec,
        network: DenseNetwork,
        options: DenseOptions,
        device: str,
        *,
        multiple: int = 1,
    ) -> None:
        self.spec = spec
        self.device = device
        self._network = network
        self._options = options
        self._multiple = multiple

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[DenseEncoding]:
        return [self._encode(picture) for picture in pictures]

    def _encode(self, picture: Picture) -> DenseEncoding:
        width, height = picture.content
        # The network accepts any size, so padding is cut off.
        content = picture.pixels[:height, :width].copy()
        pixels = torch.from_numpy(content).permute(2, 0, 1)[None]  # (1, 3, H, W)
        first_scale = self._options.first_scale
        first_size = self._first_size(picture.content, first_scale or 1.0)
        first = network_input(pixels, first_size).to(self.device)
        second = None
        if first_scale is not None:
            # From the picture again, not from the smaller input of the first pass.
            size = (max(MIN_SIDE_PX, height), max(MIN_SIDE_PX, width))
            second = network_input(pixels, size).to(self.device)
        features = self._network.encode(first, second)
        return DenseEncoding(features, picture.content, zlib.crc32(content.data))

    def _first_size(self, content: Size, scale: float) -> tuple[int, int]:
        """Return the height and width of the first pass's picture, multiples of ``multiple``."""
        multiple = self._multiple
        rows = max(1, round(content.height * scale / multiple))
        columns = max(1, round(content.width * scale / multiple))
        return multiple * rows, multiple * columns

    @torch.inference_mode()
    def candidates(
        self, first: DenseEncoding, second: DenseEncoding
    ) -> tuple[Tensor, Tensor]:
        """Return all points that matches are sampled from, and their certainties (N,).

        Points (N, 4) are x and y in the first, then the second image, normalised.
        """
        # From the grids of both images
        warps = self._network.match(first.features, second.features)
        warp = torch.cat([dense.warp.reshape(-1, 4) for dense in warps])
        certainty = torch.cat([dense.certainty.flatten() for dense in warps])
        check_finite(f"certainties of {self.spec.name}", certainty, warp)
        return warp, certainty

    def _match(self, first: DenseEncoding, second: DenseEncoding) -> Matches:
        warp, certainty = self.candidates(first, second)
        # PyTorch's CPU generator uses 32 bits of a seed, so the two checksums are combined into 32
        # bits.
        seed = zlib.crc32(second.checksum.to_bytes(4), first.checksum)
        generator = torch.Generator(warp.device).manual_seed(seed)
        index = sample_matches(
            warp, certainty, self._options.matches, self._options.threshold, generator
        )
        points = warp[index].cpu().numpy()
        return Matches(
            from_normalised(points[:, :2], first.content),
            from_normalised(points[:, 2:], second.content),
            certainty[index].cpu().numpy(),
        )
