"""SuperPoint keypoints matched by SuperGlue: the paper's matcher. Its weights are for noncommercial research."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Picture, Placement, Training
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.networks.superglue import ImageKeypoints, SuperGlue, SuperGlueConfig
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointConfig, SuperPointKeypoints
from mkpc_kaggle.matchers.sparse import image_batch
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class SuperGlueOptions:
    """SuperPoint's and SuperGlue's settings of the published outdoor evaluation.

    With SuperGlue's indoor weights the published ones are ``max_keypoints`` 1024 and ``nms_radius`` 4.
    """

    max_keypoints: int = 2048
    keypoint_threshold: float = 0.005
    nms_radius: int = 3
    sinkhorn_iterations: int = 20
    match_threshold: float = 0.2
    training: Training = Training.OUTDOOR

    def __post_init__(self) -> None:
        check_ranges(self, max_keypoints=AT_LEAST_1, keypoint_threshold=SHARE, nms_radius=AT_LEAST_0)
        check_ranges(self, sinkhorn_iterations=AT_LEAST_1, match_threshold=SHARE)


# Sides need no multiple: SuperPoint itself leaves out the last rows and columns beyond one of 8.
SPEC = MatcherSpec(
    "superglue",
    "SuperPoint with SuperGlue",
    SuperGlueOptions,
    Colour.GRAY,
    licences=("Magic-Leap-noncommercial",),
    slots=("superpoint", "superglue-{training}"),
)
LEAST_SIDE = 8
"""Pixels: SuperPoint needs at least one cell."""


@dataclass(frozen=True, eq=False)
class Encoded:
    """The keypoints of one picture, and the size of the picture that they were found on."""

    keypoints: SuperPointKeypoints
    size: Size


class SuperGlueMatcher:
    """A match's score is the keypoint's mass that the optimal transport assigns to it."""

    spec = SPEC

    def __init__(self, superpoint: SuperPoint, superglue: SuperGlue, device: str) -> None:
        self.device = device
        self._superpoint = superpoint
        self._superglue = superglue

    def encode(self, pictures: Sequence[Picture]) -> list[Encoded]:
        if any(min(picture.content) < LEAST_SIDE for picture in pictures):
            nothing = SuperPointKeypoints(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, 256))
            return [Encoded(nothing, picture.content) for picture in pictures]
        if not pictures:
            return []
        found = self._superpoint(image_batch(list(pictures), self.device))
        return [Encoded(keypoints, picture.content) for keypoints, picture in zip(found, pictures, strict=True)]

    def match(self, encodings0: Sequence[Encoded], encodings1: Sequence[Encoded]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, encoded0: Encoded, encoded1: Encoded) -> Matches:
        if len(encoded0.keypoints.points) == 0 or len(encoded1.keypoints.points) == 0:
            return Matches.empty()
        found = self._superglue(_as_pair(encoded0), _as_pair(encoded1))
        index0 = torch.nonzero(found.matches0[0] >= 0)[:, 0]
        points = encoded0.keypoints.points[index0], encoded1.keypoints.points[found.matches0[0, index0]]
        return Matches(points[0].cpu().numpy(), points[1].cpu().numpy(), found.scores0[0, index0].cpu().numpy())


def _as_pair(encoded: Encoded) -> ImageKeypoints:
    """The keypoints as a batch of one."""
    keypoints = encoded.keypoints
    return ImageKeypoints(
        keypoints.points[None], keypoints.scores[None], keypoints.descriptors[None], encoded.size
    )


def load(weights: WeightStore, options: SuperGlueOptions, placement: Placement) -> SuperGlueMatcher:
    superpoint = SuperPoint(
        SuperPointConfig(options.nms_radius, options.keypoint_threshold, options.max_keypoints)
    )
    superglue = SuperGlue(SuperGlueConfig(options.sinkhorn_iterations, options.match_threshold))
    for network, slot in zip((superpoint, superglue), SPEC.slots_for(options), strict=True):
        load_into(network, weights.load(slot), what=slot)
    return SuperGlueMatcher(placed(superpoint.eval(), placement), placed(superglue, placement), placement.device)
