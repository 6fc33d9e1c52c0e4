"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023)."""

from mkpc_kaggle.matchers.adapters.aliked import SLOT, load_encoder
from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, load_lightglue
from mkpc_kaggle.matchers.sparse import KeypointOptions
from mkpc_kaggle.weights import WeightStore

SPEC = MatcherSpec("aliked_lightglue", KeypointOptions, multiple=32, slots=(SLOT, "aliked-lightglue"))


def load(weights: WeightStore, options: KeypointOptions, placement: Placement) -> LightGlueMatcher:
    encode = load_encoder(weights, options.features, placement)
    return load_lightglue(SPEC, encode, weights, placement, input_dim=128)
