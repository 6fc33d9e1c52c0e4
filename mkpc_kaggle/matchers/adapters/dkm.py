"""DKM v3 (Edstedt et al. 2023): matches sampled from dense warps between two views."""

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dense import DenseMatcher, DenseOptions
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.weights import WeightStore, load_into

# Published: one pass at 540 x 720 (indoors 480 x 640), or two passes, the second at up to 864 x
# 1152.
SPEC = MatcherSpec("dkm", DenseOptions, slots=("dkm-{training}",))


def load(weights: WeightStore, options: DenseOptions, placement: Placement) -> DenseMatcher:
    network = DKM()
    (slot,) = SPEC.slots_for(options)
    load_into(network, weights.load(slot), what=slot)
    return DenseMatcher(SPEC, prepared(network, placement), options, placement.device)
