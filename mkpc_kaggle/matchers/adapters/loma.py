"""LoMa (Nordström et al. 2026): keypoints matched by a transformer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mkpc_kaggle.config import AT_LEAST_1, POSITIVE, SHARE, check_ranges
from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture, Placement
from mkpc_kaggle.matchers.networks.loma import (
    UNUSED,
    WIDTHS,
    Loma,
    Variant,
    detector_size,
    parameter_name,
)
from mkpc_kaggle.matchers.networks.loma_matcher import LomaKeypoints
from mkpc_kaggle.matchers.networks.pixels import resized
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.weights import WeightStore, load_into

PATCH = 14  # pixels; the side of the descriptor's input is a multiple of it


@dataclass(frozen=True)
class LomaOptions:
    """The released settings, for views with a long side of 1024 pixels."""

    variant: Variant = Variant.B
    max_keypoints: int = 2048
    threshold: float = 0.1  # the minimum score of a match
    # Side of the descriptor's square input over the longer side.
    descriptor_scale: float = 784 / 1024

    def __post_init__(self) -> None:
        check_ranges(
            self, max_keypoints=AT_LEAST_1, threshold=SHARE, descriptor_scale=POSITIVE
        )


SPEC = MatcherSpec("loma", LomaOptions, slots=("loma-{variant}",))


class LomaEncoding(NamedTuple):
    """A picture's keypoints, relative to its content."""

    keypoints: LomaKeypoints
    content: Size  # of the picture

    @property
    def points(self) -> NDArray[np.floating]:
        """The keypoints (K, 2) in view pixels."""
        return from_normalised(self.keypoints.points.cpu().numpy(), self.content)


class LomaAdapter(PairwiseMatcher[LomaEncoding]):
    """LoMa. A match's score is the product of two softmaxes, one over each picture's keypoints.

    Pictures and pairs are processed one by one, so that results do not depend on the batch.
    """

    spec = SPEC

    def __init__(self, network: Loma, options: LomaOptions, device: str) -> None:
        self.options = options
        self.device = device
        self._network = network

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[LomaEncoding]:
        return [
            LomaEncoding(self._keypoints(picture), picture.content) for picture in pictures
        ]

    def _keypoints(self, picture: Picture) -> LomaKeypoints:
        content = picture.content
        long_side = max(content)
        detected = detector_size(content, long_side)
        # A side below 8 pixels.
        if min(detected) == 0:
            descriptor, _ = WIDTHS[self.options.variant]
            no_points = torch.zeros(0, 2, device=self.device)
            return LomaKeypoints(no_points, torch.zeros(0, descriptor, device=self.device))
        # Square for any aspect ratio: the descriptor was trained so.
        side = PATCH * max(1, round(self.options.descriptor_scale * long_side / PATCH))
        # Cut off the padding, which would change the descriptors.
        shown = picture.pixels[: content.height, : content.width].copy()
        pixels = torch.from_numpy(shown).permute(2, 0, 1)[None]  # (1, 3, H, W)
        to_detect = resized(pixels, (detected.height, detected.width)).to(self.device)
        to_describe = resized(pixels, (side, side)).to(self.device)
        return self._network.encode(to_detect, to_describe, self.options.max_keypoints)

    def _match(self, first: LomaEncoding, second: LomaEncoding) -> Matches:
        found = self._network.matcher(
            first.keypoints, second.keypoints, self.options.threshold
        )
        return Matches(
            first.points[found.index0.cpu().numpy()],
            second.points[found.index1.cpu().numpy()],
            found.scores.cpu().numpy(),
        )


def load(weights: WeightStore, options: LomaOptions, placement: Placement) -> LomaAdapter:
    (slot,) = SPEC.slots_for(options)
    # Without memory: the checkpoint's tensors become the parameters.
    with torch.device("meta"):
        network = Loma(options.variant)
    tensors = {parameter_name(name): tensor for name, tensor in weights.load(slot).items()}
    load_into(network, tensors, what=slot, unused=UNUSED)
    return LomaAdapter(prepared(network, placement), options, placement.device)
