"""SuperPoint keypoints (DeTone et al. 2018) matched by LightGlue (Lindenberger et al. 2023).

SuperPoint's weights are for noncommercial research; LightGlue's are not.
"""

from dataclasses import dataclass

from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_0, SHARE, check_ranges
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.matchers.sparse import keypoint_encoder
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True)
class SuperPointLightGlueOptions(LightGlueOptions):
    """With the settings of SuperPoint in LightGlue's published evaluation.

    SuperGlue's evaluation has other settings.
    """

    nms_radius: int = 4  # half the window of non-maximum suppression, in pixels
    keypoint_threshold: float = 0.0005  # keypoints score above it

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, nms_radius=AT_LEAST_0, keypoint_threshold=SHARE)


SHAPE = LightGlueShape(descriptor=256)
# No padding to a multiple: SuperPoint ignores the rows and columns beyond a multiple of 8.
SPEC = MatcherSpec(
    "superpoint_lightglue",
    SuperPointLightGlueOptions,
    Colour.GRAY,
    slots=("superpoint", "superpoint-lightglue"),
)


def load(
    weights: WeightStore, options: SuperPointLightGlueOptions, placement: Placement
) -> LightGlueMatcher:
    network = SuperPoint(options.nms_radius, options.keypoint_threshold, options.features)
    load_into(network, weights.load("superpoint"), what="superpoint")
    on_device = prepared(network, placement)

    def detect(images: Tensor) -> list[tuple[Tensor, Tensor]]:
        return [(each.points, each.descriptors) for each in on_device(images)]

    encode = keypoint_encoder(detect, placement)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
