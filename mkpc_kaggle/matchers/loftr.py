"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from dataclasses import dataclass

from mkpc_kaggle.config import Range, check_ranges
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.loftr import Loftr, LoftrConfig
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

BORDERS = {Training.OUTDOOR: 2, Training.INDOOR: 0}  # as in the published evaluations
AS_PUBLISHED = -1


@dataclass(frozen=True)
class LoftrOptions(SemiDenseOptions):
    """``border``: coarse cells along a picture's border that get no match; -1: as published, 2, indoors 0."""

    border: int = AS_PUBLISHED

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
    network = Loftr(config_of(options))
    load_network(network, weights, *SPEC.slots_for(options))
    return SemiDenseMatcher(placed(network, placement), SPEC, placement.device)


def config_of(options: LoftrOptions) -> LoftrConfig:
    border = BORDERS[options.training] if options.border == AS_PUBLISHED else options.border
    # The indoor weights are the later ones, trained with the corrected position encoding.
    fixed_positions = options.training is Training.INDOOR
    return LoftrConfig(options.threshold, border, fixed_positions=fixed_positions)
