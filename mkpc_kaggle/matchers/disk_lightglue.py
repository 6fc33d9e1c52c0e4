"""DISK keypoints (Tyszkiewicz et al. 2020, kornia's network) matched by LightGlue (Lindenberger et al. 2023)."""

from collections.abc import Iterator

from kornia.feature import DISK
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.dtypes import check_results
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.sparse import KeypointEncoder
from mkpc_kaggle.weights import WeightStore, load_into

EXTRACTOR, LIGHTGLUE = "disk", "disk-lightglue"
SPEC = MatcherSpec(
    "disk_lightglue",
    "DISK with LightGlue",
    LightGlueOptions,
    multiple=16,
    licences=("Apache-2.0",),
    slots=(EXTRACTOR, LIGHTGLUE),
)


def disk_encoder(network: DISK, features: int, placement: Placement) -> KeypointEncoder:
    network.eval().to(placement.device)
    check_results("features of disk", network.unet)

    def detect(images: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        with autocast(placement):
            found = network(images, n=features)
        return ((each.keypoints, each.descriptors) for each in found)

    return KeypointEncoder(detect, placement.device)


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = DISK()
    load_into(network, weights.load(EXTRACTOR), what=EXTRACTOR)
    glue = load_glue(weights, LIGHTGLUE, options.threshold, input_dim=128)
    return LightGlueMatcher(SPEC, disk_encoder(network, options.features, placement), glue, placement)
