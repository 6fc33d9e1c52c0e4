"""DISK keypoints (Tyszkiewicz et al. 2020, kornia's network) matched by LightGlue (Lindenberger et al. 2023)."""

from collections.abc import Sequence

import torch
from kornia.feature import DISK

from mkpc_kaggle.matchers.contract import MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.networks.placement import autocast
from mkpc_kaggle.matchers.numbers import check_results
from mkpc_kaggle.matchers.sparse import Keypoints, image_batch
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


class DiskEncoder:
    def __init__(self, network: DISK, features: int, placement: Placement) -> None:
        self._network = network.eval().to(placement.device)
        check_results("features of disk", network.unet)
        self._features = features
        self._placement = placement

    @torch.inference_mode()
    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        if not pictures:
            return []
        batch = image_batch(list(pictures), self._placement.device)
        with autocast(self._placement):
            found = self._network(batch, n=self._features)
        return [
            Keypoints.on_content(features.keypoints.float(), features.descriptors.float(), picture.content)
            for features, picture in zip(found, pictures, strict=True)
        ]


def load(weights: WeightStore, options: LightGlueOptions, placement: Placement) -> LightGlueMatcher:
    network = DISK()
    load_into(network, weights.load(EXTRACTOR), what=EXTRACTOR)
    glue = load_glue(weights, LIGHTGLUE, options.threshold, input_dim=128)
    return LightGlueMatcher(SPEC, DiskEncoder(network, options.features, placement), glue, options, placement)
