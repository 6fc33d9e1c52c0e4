"""XFeat keypoints (kornia's network) matched by LighterGlue (Potje et al. 2024)."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.networks.placement import fold_norms
from mkpc_kaggle.matchers.sparse import Encode, library_encoder
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class LighterGlueOptions(LightGlueOptions):
    """As published, LighterGlue prunes keypoints, and runs all its layers."""

    depth_confidence: float = -1.0
    width_confidence: float = 0.95


SHAPE = LightGlueShape(descriptor=64, width=96, heads=1)  # a narrow LightGlue
SPEC = MatcherSpec(
    "xfeat_lighterglue",
    LighterGlueOptions,
    multiple=32,
    slots=("xfeat", "xfeat-lighterglue"),
    packages=("kornia",),
)


def xfeat_network(features: int) -> Any:
    """Return kornia's network without weights."""
    from kornia.feature import XFeat  # here: without kornia, other matchers run

    network = XFeat(top_k=features)
    # For semi-dense matching only; some checkpoints do not have it.
    network.net.fine_matcher = nn.Identity()  # type: ignore[assignment]
    return network


def xfeat_encoder(network: Any, features: int, placement: Placement) -> Encode:
    """Return the encoder of a loaded network, with up to ``features`` keypoints per picture."""
    fold_norms(network.eval())

    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [
            (found["keypoints"], found["descriptors"])
            for found in network.detectAndCompute(images, top_k=features)
        ]

    return library_encoder("xfeat", network, network.net, detect, placement)


def load(
    weights: WeightStore, options: LighterGlueOptions, placement: Placement
) -> LightGlueMatcher:
    network = xfeat_network(options.features)
    load_into(network.net, weights.load("xfeat"), unused=r"fine_matcher\.", what="xfeat")
    encode = xfeat_encoder(network, options.features, placement)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
