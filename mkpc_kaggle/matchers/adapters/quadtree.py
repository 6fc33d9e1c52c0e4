"""LoFTR with QuadTree attention (Tang et al. 2022)."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_semi_dense
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "quadtree", SemiDenseOptions, Colour.GRAY, Quadtree.multiple, slots=("quadtree-{training}",)
)


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    return load_semi_dense(SPEC, Quadtree(options.training), weights, options, placement)
