"""LoMa (Nordström et al. 2026): keypoints matched by a transformer, the strongest sparse matcher here."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_1, POSITIVE, SHARE, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.networks.loma import UNUSED, WIDTHS, Loma, Variant, detector_size, parameter_name
from mkpc_kaggle.matchers.networks.loma_matcher import LomaKeypoints
from mkpc_kaggle.matchers.networks.pixels import resized
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.weights import WeightStore, load_into

PATCH = 14
"""The side of the descriptor's input is a multiple of this."""


@dataclass(frozen=True)
class LomaOptions:
    """The release's settings for views with a long side of 1024.

    ``descriptor_scale``: the side of the descriptor's square input relative to the view's longer side, which is
    the detector's; 784 of 1024 pixels.
    """

    variant: Variant = Variant.B
    max_keypoints: int = 2048
    descriptor_scale: float = 0.765625
    match_threshold: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(self, max_keypoints=AT_LEAST_1, descriptor_scale=POSITIVE, match_threshold=SHARE)


SPEC = MatcherSpec(
    "loma",
    "LoMa: DaD keypoints, DeDoDe descriptors",
    LomaOptions,
    licences=("MIT",),
    slots=("loma-{variant}",),
)


@dataclass(frozen=True, eq=False)
class Encoded:
    """The keypoints of one picture, a batch of one, and the size of its content."""

    keypoints: LomaKeypoints
    content: Size


class LomaAdapter:
    """A match's score is the product of the softmax over either picture's keypoints.

    Pictures and pairs are processed one by one, so that results do not depend on the batch.
    """

    spec = SPEC

    def __init__(self, network: Loma, options: LomaOptions, device: str) -> None:
        self.options = options
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Encoded]:
        return [Encoded(self._keypoints(picture), picture.content) for picture in pictures]

    @torch.inference_mode()
    def match(self, encodings0: Sequence[Encoded], encodings1: Sequence[Encoded]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _keypoints(self, picture: Picture) -> LomaKeypoints:
        content, longest = picture.content, max(picture.content)
        detected = detector_size(content, longest)
        if min(detected) == 0:
            channels = WIDTHS[self.options.variant].descriptor
            return LomaKeypoints(torch.zeros(1, 0, 2), torch.zeros(1, 0, channels))
        side = PATCH * max(1, round(self.options.descriptor_scale * longest / PATCH))
        # Without padding, which would affect the descriptors.
        pixels = torch.from_numpy(picture.pixels[: content.height, : content.width].copy()).permute(2, 0, 1)[None]
        to_detect = resized(pixels, (detected.height, detected.width)).to(self.device)
        to_describe = resized(pixels, (side, side)).to(self.device)
        return self._network.encode(to_detect, to_describe, self.options.max_keypoints)

    def _match(self, encoded0: Encoded, encoded1: Encoded) -> Matches:
        keypoints = encoded0.keypoints, encoded1.keypoints
        found = self._network.matcher(*keypoints, self.options.match_threshold)
        index0 = torch.nonzero(found.matches0[0] >= 0)[:, 0]
        indices = index0, found.matches0[0, index0]
        points0, points1 = (
            from_normalised(one.points[0, index].cpu().numpy(), encoded.content)
            for one, index, encoded in zip(keypoints, indices, (encoded0, encoded1), strict=True)
        )
        return Matches(points0, points1, found.scores0[0, index0].cpu().numpy())


def load(weights: WeightStore, options: LomaOptions, placement: Placement) -> LomaAdapter:
    (slot,) = SPEC.slots_for(options)
    with torch.device("meta"):
        network = Loma(options.variant)
    tensors = {parameter_name(name): tensor for name, tensor in weights.load(slot).items()}
    load_into(network, tensors, what=slot, unused=UNUSED)
    return LomaAdapter(placed(network, placement), options, placement.device)
