"""DISK keypoints (Tyszkiewicz et al. 2020) matched by LightGlue (Lindenberger et al. 2023).

DISK's network is kornia's.
"""

from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.sparse import library_encoder
from mkpc_kaggle.weights import WeightStore, load_into

SHAPE = LightGlueShape(descriptor=128)
SPEC = MatcherSpec(
    "disk_lightglue",
    LightGlueOptions,
    multiple=16,
    slots=("disk", "disk-lightglue"),
    packages=("kornia",),
)


def load(
    weights: WeightStore, options: LightGlueOptions, placement: Placement
) -> LightGlueMatcher:
    from kornia.feature import DISK  # here: without kornia, other matchers run

    network = DISK()
    load_into(network, weights.load("disk"), what="disk")

    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [
            (found.keypoints, found.descriptors)
            for found in network(images, n=options.features)
        ]

    encode = library_encoder("disk", network, network.unet, detect, placement)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
