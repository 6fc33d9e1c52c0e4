"""ASpanFormer (Chen et al. 2022). Its weights are for noncommercial use."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement, TrainedOptions
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, load_semi_dense
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "aspanformer", TrainedOptions, Colour.GRAY, AspanFormer.multiple, slots=("aspanformer-{training}",)
)


def load(weights: WeightStore, options: TrainedOptions, placement: Placement) -> SemiDenseMatcher:
    network = AspanFormer(options.training)
    # Checkpoints also have offsets that the published network does not use.
    return load_semi_dense(SPEC, network, weights, options, placement, unused=r".*\.sample_offset$")
