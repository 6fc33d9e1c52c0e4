"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.loftr import Loftr, LoftrConfig
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "loftr",
    "LoFTR",
    SemiDenseOptions,
    Colour.GRAY,
    multiple=Loftr.multiple,
    licences=("Apache-2.0",),
    slots=("loftr-{training}",),
)


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    # The indoor weights are the later ones, trained with the mended position encoding.
    fixed_positions = options.training is Training.INDOOR
    network = Loftr(LoftrConfig(threshold=options.threshold, fixed_positions=fixed_positions))
    load_network(network, weights, *SPEC.slots_for(options))
    return SemiDenseMatcher(placed(network, placement), SPEC, placement.device)
