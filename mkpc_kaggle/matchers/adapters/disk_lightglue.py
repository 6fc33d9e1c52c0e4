"""DISK keypoints (Tyszkiewicz et al. 2020, kornia's network) matched by LightGlue (Lindenberger et
al. 2023).
"""

import torch
from kornia.feature import DISK
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.sparse import Encode, keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SHAPE = LightGlueShape(descriptor=128)
SPEC = MatcherSpec(
    "disk_lightglue", LightGlueOptions, multiple=16, slots=("disk", "disk-lightglue")
)


def disk_encoder(network: DISK, features: int, placement: Placement) -> Encode:
    """Return the encoder of a loaded network, which raises if its features are not finite."""
    network.eval().to(placement.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.unet.register_forward_hook(lambda *call: check_finite("features of disk", call[-1]))

    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        with autocast(placement):
            found = network(images, n=features)
        return [(each.keypoints, each.descriptors) for each in found]

    return keypoint_encoder(detect, placement)


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = DISK()
    load_into(network, weights.load("disk"), what="disk")
    encode = disk_encoder(network, options.features, placement)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
