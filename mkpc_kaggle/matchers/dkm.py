"""DKM v3 (Edstedt et al. 2023): places for all pixels of either view in the other; matches are drawn from them."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_1, SHARE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement, Training
from mkpc_kaggle.matchers.networks.dkm import DKM, DkmConfig, DkmFeatures, SamplingConfig, network_input, sample
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.numbers import check_finite
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class DkmOptions:
    """``passes``: 1, or 2: then the first looks at pictures with their sides shrunk to the share ``first_pass``,
    the second at all of them. Published are one of 540 x 720 or 480 x 640 (indoors), and two of 864 x 1152.

    ``matches``: drawn at most, spread evenly if ``balanced``; certainties above ``threshold`` count alike.
    ``symmetric``: from both pictures to the other, else from the first to the second only, in half the time.
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


# The licence is that of the outdoor weights; the terms of the indoor ones are unclear, as the manifest says.
SPEC = MatcherSpec("dkm", "DKM v3", DkmOptions, licences=("MIT",), slots=("dkm-{training}",))


@dataclass(frozen=True, eq=False)
class Encoded:
    """One picture's features, the size of its content, and a number that stands for its pixels."""

    features: DkmFeatures
    content: Size
    digest: int


class DkmMatcher:
    """A match's score is its certainty. Which matches are drawn depends on the two pictures alone.

    Pictures and pairs are taken one by one, so that no batch changes what is found.
    """

    spec = SPEC

    def __init__(self, network: DKM, options: DkmOptions, device: str) -> None:
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
        # The network takes any size, so it never sees the padding.
        content = picture.pixels[:height, :width].copy()
        pixels = torch.from_numpy(content).permute(2, 0, 1)[None]  # (1, 3, H, W)
        whole = network_input(pixels, (height, width)).to(self.device)
        if self.options.passes == 1:
            features = self._network.encode(whole)
        else:
            shrunk = (
                max(1, round(height * self.options.first_pass)),
                max(1, round(width * self.options.first_pass)),
            )
            features = self._network.encode(network_input(pixels, shrunk).to(self.device), whole)
        return Encoded(features, picture.content, zlib.crc32(content.data))

    def _match(self, encoded0: Encoded, encoded1: Encoded) -> Matches:
        warps = self._network.match(encoded0.features, encoded1.features)
        warp = torch.cat([dense.warp.reshape(-1, 4) for dense in warps])
        certainty = torch.cat([dense.certainty.flatten() for dense in warps])
        check_finite("certainties of dkm", certainty, warp)
        # PyTorch's generator on a CPU reads 32 bits of a seed, so both digests are mixed into so many.
        seed = zlib.crc32(encoded1.digest.to_bytes(4), encoded0.digest)
        generator = torch.Generator(warp.device).manual_seed(seed)
        found = sample(warp, certainty, self._sampling, generator)
        points = found.matches.cpu().numpy()
        return Matches(
            from_normalised(points[:, :2], encoded0.content),
            from_normalised(points[:, 2:], encoded1.content),
            certainty[found.index].cpu().numpy(),
        )


def load(weights: WeightStore, options: DkmOptions, placement: Placement) -> DkmMatcher:
    network = DKM(DkmConfig(options.symmetric))
    (slot,) = SPEC.slots_for(options)
    load_into(network, weights.load(slot), what=slot)
    return DkmMatcher(placed(network, placement), options, placement.device)
