"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_semi_dense
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "loftr", SemiDenseOptions, Colour.GRAY, Loftr.multiple, slots=("loftr-{training}",)
)


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    return load_semi_dense(SPEC, Loftr(options.training), weights, options, placement)
