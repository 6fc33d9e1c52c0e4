"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from dataclasses import dataclass

from mkpc_kaggle.config import Range, check_ranges
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

BORDERS = {Training.OUTDOOR: 2, Training.INDOOR: 0}  # as in the published evaluations
AS_PUBLISHED = -1


@dataclass(frozen=True)
class LoftrOptions(SemiDenseOptions):
    border: int = AS_PUBLISHED  # coarse cells along a picture's border that get no match; -1: 2, indoors 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, border=Range(AS_PUBLISHED))


SPEC = MatcherSpec(
    "loftr",
    "LoFTR",
    LoftrOptions,
    Colour.GRAY,
    multiple=Loftr.multiple,
    licences=("Apache-2.0",),
    slots=("loftr-{training}",),
)


def load(weights: WeightStore, options: LoftrOptions, placement: Placement) -> SemiDenseMatcher:
    network = network_of(options)
    load_network(network, weights, *SPEC.slots_for(options))
    return SemiDenseMatcher(placed(network, placement), SPEC, placement.device)


def network_of(options: LoftrOptions) -> Loftr:
    """Without weights."""
    border = BORDERS[options.training] if options.border == AS_PUBLISHED else options.border
    # The indoor weights are the later ones, trained with the corrected position encoding.
    return Loftr(options.threshold, border, fixed_positions=options.training is Training.INDOOR)
