"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

# Coarse cells along the border of a picture without matches, as in the published evaluations.
BORDERS = {Training.OUTDOOR: 2, Training.INDOOR: 0}


SPEC = MatcherSpec("loftr", SemiDenseOptions, Colour.GRAY, Loftr.multiple, slots=("loftr-{training}",))


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    # The indoor weights were trained later, with the corrected position encoding.
    is_indoor = options.training is Training.INDOOR
    network = Loftr(options.threshold, BORDERS[options.training], fixed_positions=is_indoor)
    load_network(network, weights, *SPEC.slots_for(options))
    return SemiDenseMatcher(prepared(network, placement), SPEC, placement.device)
