"""The adapter of the dense networks: features for each picture, matches sampled from the warps of a pair."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_1, SHARE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Training
from mkpc_kaggle.matchers.networks.dense_sampling import SamplingConfig, sample
from mkpc_kaggle.matchers.networks.dense_warp import DenseWarp
from mkpc_kaggle.matchers.networks.pixels import network_input
from mkpc_kaggle.matchers.numbers import check_finite


@dataclass(frozen=True)
class DenseOptions:
    """``passes``: 1 or 2; with 2 the first is on pictures whose sides are scaled by ``first_pass``, the second on
    the full ones.

    ``matches``: most to sample, spread evenly if ``balanced``; certainties above ``threshold`` count as 1.
    ``symmetric``: match both ways, else from the first to the second only, in half the time.
    """

    passes: int = 1
    first_pass: float = 0.625
    symmetric: bool = True
    matches: int = 5000
    threshold: float = 0.05
    balanced: bool = True
    training: Training = Training.OUTDOOR

    def __post_init__(self) -> None:
        check_ranges(self, passes=Range(1, 2), first_pass=Range(0, 1, "(]"), matches=AT_LEAST_1, threshold=SHARE)


class DenseNetwork(Protocol):
    """``encode``: features of an image (1, 3, H, W), and of a larger version of it for the second pass."""

    def encode(self, image: Tensor, fine: Tensor | None = None) -> Any: ...

    def match(self, first: Any, second: Any) -> tuple[DenseWarp, ...]: ...


@dataclass(frozen=True, eq=False)
class Encoded:
    """One picture's features, the size of its content, and a checksum of its pixels."""

    features: Any
    content: Size
    digest: int


class DenseMatcher:
    """A match's score is its certainty. Which matches are sampled depends on the two pictures alone.

    Pictures and pairs are processed one by one, so that results do not depend on the batch. ``multiple``: sides of
    the first pass's image are multiples of it; ``least``: the shortest side of any image.
    """

    spec: ClassVar[MatcherSpec]
    multiple: ClassVar[int] = 1
    least: ClassVar[int] = 1

    def __init__(self, network: DenseNetwork, options: DenseOptions, device: str) -> None:
        self.options = options
        self.device = device
        self._network = network
        self._sampling = SamplingConfig(options.matches, threshold=options.threshold, balanced=options.balanced)

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Encoded]:
        return [self._encode(picture) for picture in pictures]

    @torch.inference_mode()
    def match(self, encodings0: Sequence[Encoded], encodings1: Sequence[Encoded]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _encode(self, picture: Picture) -> Encoded:
        width, height = picture.content
        # The network takes any size, so that padding is cut off.
        content = picture.pixels[:height, :width].copy()
        pixels = torch.from_numpy(content).permute(2, 0, 1)[None]  # (1, 3, H, W)
        first = network_input(pixels, self._first_size(picture.content)).to(self.device)
        second = None
        if self.options.passes == 2:
            second = network_input(pixels, (max(self.least, height), max(self.least, width))).to(self.device)
        return Encoded(self._network.encode(first, second), picture.content, zlib.crc32(content.data))

    def _first_size(self, content: Size) -> tuple[int, int]:
        """(H, W) of the image that the first pass sees."""
        share = self.options.first_pass if self.options.passes == 2 else 1
        height, width = (
            self.multiple * max(1, round(side * share / self.multiple)) for side in (content.height, content.width)
        )
        return height, width

    def _match(self, encoded0: Encoded, encoded1: Encoded) -> Matches:
        warps = self._network.match(encoded0.features, encoded1.features)
        warp = torch.cat([dense.warp.reshape(-1, 4) for dense in warps])
        certainty = torch.cat([dense.certainty.flatten() for dense in warps])
        check_finite(f"certainties of {self.spec.name}", certainty, warp)
        # PyTorch's CPU generator uses 32 bits of a seed, so both checksums are combined into 32.
        seed = zlib.crc32(encoded1.digest.to_bytes(4), encoded0.digest)
        generator = torch.Generator(warp.device).manual_seed(seed)
        found = sample(warp, certainty, self._sampling, generator)
        points = found.matches.cpu().numpy()
        return Matches(
            from_normalised(points[:, :2], encoded0.content),
            from_normalised(points[:, 2:], encoded1.content),
            certainty[found.index].cpu().numpy(),
        )
