"""ASpanFormer (Chen et al. 2022). Its weights are for noncommercial use."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, Training
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "aspanformer", SemiDenseOptions, Colour.GRAY, AspanFormer.multiple, slots=("aspanformer-{training}",)
)
# The border, and the size to which positions are scaled. Indoor weights were published for 480 x 640 only, with
# unscaled positions and a global level of 15 x 20 cells. At this size our scaling and pooling are the same.
GRIDS = {Training.OUTDOOR: (2, (832, 832)), Training.INDOOR: (0, (480, 640))}


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    network = AspanFormer(options.threshold, *GRIDS[options.training])
    # Checkpoints also have offsets that the published network does not use.
    load_network(network, weights, *SPEC.slots_for(options), unused=r".*\.sample_offset$")
    return SemiDenseMatcher(prepared(network, placement), SPEC, placement.device)
