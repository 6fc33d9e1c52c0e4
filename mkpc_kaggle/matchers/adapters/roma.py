"""RoMa (Edstedt et al. 2024): DKM's warps from DINOv2's features, the best single matcher in our benchmark."""

import torch

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement, TrainedOptions, Training
from mkpc_kaggle.matchers.dense import DenseMatcher
from mkpc_kaggle.matchers.networks.dinov2 import PATCH
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.weights import WeightStore, load_into

SPEC = MatcherSpec("roma", TrainedOptions, slots=("roma-{training}", "dinov2-vitl14"))
# Published: passes at 560 x 560 and 864 x 864, as in a stretched unit of 864 x 864; indoors one at 560 x 560.
FIRST_PASSES = {Training.OUTDOOR: 0.648, Training.INDOOR: None}


def load(weights: WeightStore, options: TrainedOptions, placement: Placement) -> DenseMatcher:
    own, backbone = SPEC.slots_for(options)
    with torch.device("meta"):
        network = RoMa()
    load_into(network.dinov2, weights.load(backbone), what=backbone)
    load_into(network, weights.load(own), unused=r"dinov2\.", what=own)
    first_pass = FIRST_PASSES[options.training]
    return DenseMatcher(
        SPEC, prepared(network, placement), placement.device, multiple=PATCH, first_pass=first_pass
    )
