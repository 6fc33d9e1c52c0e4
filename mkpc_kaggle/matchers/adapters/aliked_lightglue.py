"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023)."""

from dataclasses import dataclass

from mkpc_kaggle.matchers.adapters.aliked import SLOT, AlikedVariant, load_encoder
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.weights import WeightStore


@dataclass(frozen=True)
class AlikedLightGlueOptions(LightGlueOptions):
    """LightGlue was trained on the keypoints of n16."""

    variant: AlikedVariant = AlikedVariant.N16


SHAPE = LightGlueShape(descriptor=128)
SPEC = MatcherSpec(
    "aliked_lightglue", AlikedLightGlueOptions, multiple=32, slots=(SLOT, "aliked-lightglue")
)


def load(
    weights: WeightStore, options: AlikedLightGlueOptions, placement: Placement
) -> LightGlueMatcher:
    encode = load_encoder(weights, options.features, options.variant, placement)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
