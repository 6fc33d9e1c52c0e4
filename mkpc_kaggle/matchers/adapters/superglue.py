"""SuperPoint keypoints matched by SuperGlue, as in the MKPC paper.

Both weights are for noncommercial research.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import (
    Colour,
    MatcherSpec,
    PairwiseMatcher,
    Picture,
    Placement,
    TrainedOptions,
)
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointKeypoints
from mkpc_kaggle.matchers.sparse import image_batch, matches_of
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class SuperGlueOptions(TrainedOptions):
    """Settings of the published outdoor evaluation.

    The published indoor evaluation uses ``max_keypoints`` 1024 and ``nms_radius`` 4.
    """

    max_keypoints: int = 2048  # the strongest of a picture
    keypoint_threshold: float = 0.005  # the minimum score of a keypoint
    nms_radius: int = 3  # half the window of non-maximum suppression, in pixels
    sinkhorn_iterations: int = 20  # of the optimal transport
    match_threshold: float = 0.2  # the minimum score of a match

    def __post_init__(self) -> None:
        check_ranges(self, max_keypoints=AT_LEAST_1, nms_radius=AT_LEAST_0)
        check_ranges(self, sinkhorn_iterations=AT_LEAST_1)
        check_ranges(self, keypoint_threshold=SHARE, match_threshold=SHARE)


# No padding to a multiple: SuperPoint ignores the rows and columns beyond a multiple of 8.
SPEC = MatcherSpec(
    "superglue", SuperGlueOptions, Colour.GRAY, slots=("superpoint", "superglue-{training}")
)


class SuperGlueMatcher(PairwiseMatcher[SuperPointKeypoints]):
    """SuperGlue. A match's score is its mass in the optimal transport plan."""

    spec = SPEC

    def __init__(self, superpoint: SuperPoint, superglue: SuperGlue, device: str) -> None:
        self.device = device
        self._superpoint = superpoint
        self._superglue = superglue

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[SuperPointKeypoints]:
        return list(self._superpoint(image_batch(pictures, self.device)))

    def _match(
        self, keypoints0: SuperPointKeypoints, keypoints1: SuperPointKeypoints
    ) -> Matches:
        found = self._superglue(keypoints0, keypoints1)
        return matches_of(keypoints0.points, keypoints1.points, found)


def load(
    weights: WeightStore, options: SuperGlueOptions, placement: Placement
) -> SuperGlueMatcher:
    superpoint = SuperPoint(
        options.nms_radius, options.keypoint_threshold, options.max_keypoints
    )
    superglue = SuperGlue(options.sinkhorn_iterations, options.match_threshold)
    for network, slot in zip((superpoint, superglue), SPEC.slots_for(options), strict=True):
        load_into(network, weights.load(slot), what=slot)
    return SuperGlueMatcher(
        prepared(superpoint, placement), prepared(superglue, placement), placement.device
    )
