"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023)."""

from mkpc_kaggle.matchers.adapters.aliked import SLOT, load_encoder
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec("aliked_lightglue", LightGlueOptions, multiple=32, slots=(SLOT, "aliked-lightglue"))


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    encoder = load_encoder(weights, options.features, placement)
    glue = load_glue(weights, "aliked-lightglue", options.threshold, input_dim=128)
    return LightGlueMatcher(SPEC, encoder, glue, placement)
