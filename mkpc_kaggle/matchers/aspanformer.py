"""ASpanFormer (Chen et al. 2022), outdoor weights, which are for noncommercial use."""

from mkpc_kaggle.matchers.contract import Colour, MatcherSpec
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer, AspanFormerConfig
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher, SemiDenseOptions, load_network
from mkpc_kaggle.weights import WeightStore

SLOT = "aspanformer-outdoor"

SPEC = MatcherSpec(
    "aspanformer",
    "ASpanFormer, outdoor weights",
    SemiDenseOptions,
    Colour.GRAY,
    multiple=AspanFormer.multiple,
    licences=("Apple-noncommercial",),
    slots=(SLOT,),
)


def load(weights: WeightStore, options: SemiDenseOptions, device: str) -> SemiDenseMatcher:
    network = AspanFormer(AspanFormerConfig(threshold=options.threshold))
    # Checkpoints hold offsets besides that the published network never reads.
    load_network(network, weights, SLOT, unused=r".*\.sample_offset$")
    return SemiDenseMatcher(network, SPEC, device)
