"""LoFTR (Sun et al. 2021), outdoor weights with dual softmax."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec
from mkpc_kaggle.matchers.networks.loftr import Loftr, LoftrConfig
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SLOT = "loftr-outdoor"

SPEC = MatcherSpec(
    "loftr",
    "LoFTR, outdoor weights",
    SemiDenseOptions,
    Colour.GRAY,
    multiple=Loftr.multiple,
    licences=("Apache-2.0",),
    slots=(SLOT,),
)


def load(weights: WeightStore, options: SemiDenseOptions, device: str) -> SemiDenseMatcher:
    network = Loftr(LoftrConfig(threshold=options.threshold))
    load_network(network, weights, SLOT)
    return SemiDenseMatcher(network, SPEC, device)
