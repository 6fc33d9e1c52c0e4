"""RoMa (Edstedt et al. 2024): DKM's warps from DINOv2's features."""

from dataclasses import dataclass

import torch

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.dense import DenseMatcher, DenseOptions
from mkpc_kaggle.matchers.networks.dinov2 import PATCH
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class RomaOptions(DenseOptions):
    """The options of a dense matcher, with the defaults of RoMa's publication."""

    # Passes at 560 x 560 and 864 x 864, as in a stretched unit of 864 x 864; indoors one at 560 x 560
    passes: int = 0  # 0: as published
    first_pass: float = 0.648

    def __post_init__(self) -> None:
        if not self.passes:
            object.__setattr__(self, "passes", 1 if self.training is Training.INDOOR else 2)
        super().__post_init__()


SPEC = MatcherSpec("roma", RomaOptions, slots=("roma-{training}", "dinov2-vitl14"))


def load(weights: WeightStore, options: RomaOptions, placement: Placement) -> DenseMatcher:
    own, backbone = SPEC.slots_for(options)
    # Without memory: the checkpoints' tensors become the parameters.
    with torch.device("meta"):
        network = RoMa()
    load_into(network.dinov2, weights.load(backbone), what=backbone)
    # RoMa's own file has no DINOv2: its parameters may be missing there.
    load_into(network, weights.load(own), unused=r"dinov2\.", what=own)
    return DenseMatcher(
        SPEC, prepared(network, placement), options, placement.device, multiple=PATCH
    )
