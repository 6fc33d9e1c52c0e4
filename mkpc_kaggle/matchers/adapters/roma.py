"""RoMa (Edstedt et al. 2024): DKM's warps on DINOv2's features, the best single matcher of this benchmark."""

from dataclasses import dataclass

import torch

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dense import DenseMatcher, DenseOptions
from mkpc_kaggle.matchers.networks.dinov2 import PATCH
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class RomaOptions(DenseOptions):
    # Published: two passes of 560 x 560 and 864 x 864, as in a stretched unit of 864 x 864; indoors one of 560.
    passes: int = 2
    first_pass: float = 0.648


SPEC = MatcherSpec("roma", RomaOptions, slots=("roma-{training}", "dinov2-vitl14"))


class RomaMatcher(DenseMatcher):
    spec = SPEC
    multiple, min_side_px = PATCH, 8


def load(weights: WeightStore, options: RomaOptions, placement: Placement) -> RomaMatcher:
    own, backbone = SPEC.slots_for(options)
    with torch.device("meta"):
        network = RoMa()
    tensors = {f"dinov2.{name}": tensor for name, tensor in weights.load(backbone).items()}
    load_into(network, tensors | weights.load(own), what=f"{own} with {backbone}")
    return RomaMatcher(prepared(network, placement), options, placement.device)
