"""DISK keypoints (Tyszkiewicz et al. 2020, kornia's network) matched by LightGlue (Lindenberger et al. 2023)."""

from kornia.feature import DISK
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, load_lightglue
from mkpc_kaggle.matchers.sparse import Encode, KeypointOptions, keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SPEC = MatcherSpec("disk_lightglue", KeypointOptions, multiple=16, slots=("disk", "disk-lightglue"))


def disk_encoder(network: DISK, features: int, placement: Placement) -> Encode:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [(each.keypoints, each.descriptors) for each in network(images, n=features)]

    return keypoint_encoder(network, network.unet, detect, placement)


def load(weights: WeightStore, options: KeypointOptions, placement: Placement) -> LightGlueMatcher:
    network = DISK()
    load_into(network, weights.load("disk"), what="disk")
    encode = disk_encoder(network, options.features, placement)
    return load_lightglue(SPEC, encode, weights, placement, input_dim=128)
