"""ASpanFormer (Chen et al. 2022). Its weights are for noncommercial use."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_semi_dense
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec(
    "aspanformer",
    SemiDenseOptions,
    Colour.GRAY,
    AspanFormer.multiple,
    slots=("aspanformer-{training}",),
)


def load(weights: WeightStore, options: SemiDenseOptions, placement: Placement) -> SemiDenseMatcher:
    network = AspanFormer(options.training)
    # Checkpoints also have offsets that the published network does not use.
    return load_semi_dense(SPEC, network, weights, options, placement, unused=r".*\.sample_offset$")
