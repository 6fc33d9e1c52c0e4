"""XFeat keypoints matched by LighterGlue (Potje et al. 2024; kornia's networks), refined by Keypt2Subpx."""

from dataclasses import dataclass

from kornia.feature import XFeat
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement, Refine
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.sparse import KeypointEncoder, library_encoder
from mkpc_kaggle.matchers.subpixel import Refiner, load_refiner
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class XFeatOptions(LightGlueOptions):
    refine: Refine = Refine.IF_FOUND  # its keypoints, which are whole pixels


DESCRIPTOR_DIM = 64
SHAPE = {"input_dim": DESCRIPTOR_DIM, "descriptor_dim": 96, "num_heads": 1}  # LighterGlue is a narrow LightGlue
SPEC = MatcherSpec(
    "xfeat_lighterglue",
    "XFeat with LighterGlue: fast, learned",
    XFeatOptions,
    multiple=32,
    licences=("Apache-2.0",),
    slots=("xfeat", "xfeat-lighterglue"),
    refiner="keypt2subpx-xfeat",
)


def xfeat_encoder(
    network: XFeat, features: int, placement: Placement, refiner: Refiner | None = None
) -> KeypointEncoder:
    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        found = network.detectAndCompute(images, top_k=features)
        return [(each["keypoints"], each["descriptors"]) for each in found]

    patches = None if refiner is None else refiner.patches
    return library_encoder(network, network.net, detect, placement, patches)


def load(weights: WeightStore, options: XFeatOptions, placement: Placement) -> LightGlueMatcher:
    network = XFeat(top_k=options.features)
    # Its fine matcher serves semi-dense matching only; some checkpoints are without it.
    load_into(network.net, weights.load("xfeat"), unused=r"fine_matcher\.", what="xfeat")
    refiner = load_refiner(weights, SPEC, options.refine, DESCRIPTOR_DIM, placement)
    encoder = xfeat_encoder(network, options.features, placement, refiner)
    glue = load_glue(weights, "xfeat-lighterglue", options.threshold, **SHAPE)
    return LightGlueMatcher(SPEC, encoder, glue, placement, refiner)
