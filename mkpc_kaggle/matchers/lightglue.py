"""LightGlue (Lindenberger et al. 2023): shared by all matchers that use it."""

import re
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mkpc_kaggle.config import Range, check_ranges
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Placement
from mkpc_kaggle.matchers.networks.lightglue import (
    LightGlue,
    LightGlueShape,
    normalised,
)
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.sparse import Encode, KeypointOptions, Keypoints, matches_of
from mkpc_kaggle.weights import WeightStore, load_into

# Of a training wrapper around LighterGlue, and a former parameter of LightGlue's assignment.
SURPLUS = r"extractor\.|log_assignment\.\d+\.r$|confidence_thresholds$"


@dataclass(frozen=True)
class LightGlueOptions(KeypointOptions):
    """Settings of LightGlue, with the published defaults.

    ``depth_confidence``: the share of confident keypoints after which no further layer runs.
    ``width_confidence``: confident keypoints that have no match with this probability are dropped.
    -1 turns either off. ``filter_threshold``: matches score above it.
    """

    depth_confidence: float = 0.95
    width_confidence: float = 0.99
    filter_threshold: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        share = Range(-1, 1)
        check_ranges(
            self, depth_confidence=share, width_confidence=share, filter_threshold=Range(0, 1)
        )


class LightGlueMatcher(PairwiseMatcher[Keypoints]):
    """LightGlue on an encoder's keypoints. Scores are LightGlue's."""

    def __init__(
        self, spec: MatcherSpec, encode: Encode, glue: LightGlue, placement: Placement
    ) -> None:
        self.spec = spec
        self.placement = placement
        self.encode = encode
        self._glue = prepared(glue, placement)

    def _match(self, keypoints0: Keypoints, keypoints1: Keypoints) -> Matches:
        found = self._glue(
            _positions(keypoints0),
            keypoints0.descriptors,
            _positions(keypoints1),
            keypoints1.descriptors,
        )
        return matches_of(keypoints0.points, keypoints1.points, found)


def _positions(keypoints: Keypoints) -> Tensor:
    """Return the positions (K, 2) of keypoints, or (K, 4) with scales and orientations."""
    # By the size of the content, without padding: LightGlue was trained on whole images.
    points = normalised(keypoints.points, *keypoints.content)
    if keypoints.scales is None or keypoints.orientations is None:
        return points
    shapes = torch.stack([keypoints.scales, keypoints.orientations], dim=1)
    return torch.cat([points, shapes], dim=1)


def load_lightglue(
    spec: MatcherSpec,
    encode: Encode,
    weights: WeightStore,
    options: LightGlueOptions,
    placement: Placement,
    shape: LightGlueShape,
) -> LightGlueMatcher:
    """Load LightGlue from the weights of the spec's last slot, with all layers of these weights.

    Weights without confidences run all their layers on all keypoints.
    """
    slot = spec.slots_for(options)[-1]
    tensors = {layer_name(name): tensor for name, tensor in weights.load(slot).items()}
    # "transformers.8.self_attn...": the last number gives the layers. LighterGlue has fewer.
    layers = {int(name.split(".")[1]) for name in tensors if name.startswith("transformers.")}
    shape = replace(shape, layers=1 + max(layers, default=0))
    adapts = any(name.startswith("token_confidence.") for name in tensors)
    glue = LightGlue(
        shape,
        options.depth_confidence,
        options.width_confidence,
        options.filter_threshold,
        adapts=adapts,
    )
    unused = SURPLUS
    # Without early stopping and pruning only the last layer's assignment is used.
    if not glue.adapts:
        unused += rf"|token_confidence\.|log_assignment\.(?!{shape.layers - 1}\.)"
    load_into(glue, tensors, unused=unused, what=slot)
    return LightGlueMatcher(spec, encode, glue, placement)


def layer_name(name: str) -> str:
    """Return the current name of a parameter of an older checkpoint or of a training wrapper."""
    own = name.removeprefix("matcher.")
    return re.sub(r"^(self|cross)_attn\.(\d+)\.", r"transformers.\2.\1_attn.", own)
