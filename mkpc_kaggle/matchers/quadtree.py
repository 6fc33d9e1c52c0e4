"""LoFTR with QuadTree attention (Tang et al. 2022), outdoor weights."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec
from mkpc_kaggle.matchers.networks.quadtree import Quadtree, QuadtreeConfig
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SLOT = "quadtree-outdoor"

SPEC = MatcherSpec(
    "quadtree",
    "LoFTR with QuadTree attention, outdoor weights",
    SemiDenseOptions,
    Colour.GRAY,
    multiple=Quadtree.multiple,
    licences=("Apache-2.0",),
    slots=(SLOT,),
)


def load(weights: WeightStore, options: SemiDenseOptions, device: str) -> SemiDenseMatcher:
    network = Quadtree(QuadtreeConfig(threshold=options.threshold))
    load_network(network, weights, SLOT)
    return SemiDenseMatcher(network, SPEC, device)
