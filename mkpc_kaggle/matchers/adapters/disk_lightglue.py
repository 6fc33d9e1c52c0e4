"""DISK keypoints (Tyszkiewicz et al. 2020, kornia's network) matched by LightGlue (Lindenberger et al. 2023)."""

from kornia.feature import DISK
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.sparse import KeypointEncoder, library_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SPEC = MatcherSpec("disk_lightglue", LightGlueOptions, multiple=16, slots=("disk", "disk-lightglue"))


def disk_encoder(network: DISK, features: int, placement: Placement) -> KeypointEncoder:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [(each.keypoints, each.descriptors) for each in network(images, n=features)]

    return library_encoder(network, network.unet, detect, placement)


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = DISK()
    load_into(network, weights.load("disk"), what="disk")
    encoder = disk_encoder(network, options.features, placement)
    glue = load_glue(weights, "disk-lightglue", options.threshold, input_dim=128)
    return LightGlueMatcher(SPEC, encoder, glue, placement)
