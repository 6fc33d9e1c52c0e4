"""LoFTR with QuadTree attention (Tang et al. 2022)."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec("quadtree", SemiDenseOptions, Colour.GRAY, Quadtree.multiple, slots=("quadtree-{training}",))
TOPKS = {Training.OUTDOOR: (16, 8), Training.INDOOR: (32, 16)}  # as published


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    network = Quadtree(options.threshold, topks=TOPKS[options.training])
    load_network(network, weights, *SPEC.slots_for(options))
    return SemiDenseMatcher(prepared(network, placement), SPEC, placement.device)
