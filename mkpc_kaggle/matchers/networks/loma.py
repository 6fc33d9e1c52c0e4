"""LoMa: DaD keypoints, DeDoDe descriptors and a LightGlue-like matcher.

Source: Nordström et al. 2026, arXiv 2604.04931. One public checkpoint has all three. Variants
differ in the descriptor and in the matcher's width. For inference only.
"""

from enum import StrEnum

from torch import Tensor, nn

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.networks.dad import Dad
from mkpc_kaggle.matchers.networks.dedode import Dedode
from mkpc_kaggle.matchers.networks.loma_matcher import LAYERS, LomaKeypoints, LomaMatcher


class Variant(StrEnum):
    """The published checkpoints.

    Only B128 has the light descriptor without a vision transformer. R is B trained with rotations.
    L and G have wider matchers.
    """

    B128 = "b128"
    B = "b"
    R = "r"
    L = "l"
    G = "g"


# Channels of descriptors and of the matcher.
WIDTHS = {
    Variant.B128: (128, 256),
    Variant.B: (256, 256),
    Variant.R: (256, 256),
    Variant.L: (256, 512),
    Variant.G: (256, 1024),
}
# For training only: assignments of other layers, matchability, further layers.
UNUSED = rf"matcher\.(log_assignment\.(?!{LAYERS - 1}\.final_proj\.)|transformers\.(?![0-{LAYERS - 1}]\.))"


class Loma(nn.Module):
    def __init__(self, variant: Variant) -> None:
        super().__init__()
        descriptor, width = WIDTHS[variant]
        self.detector = Dad()
        self.descriptor = Dedode(descriptor, with_vit=variant is not Variant.B128)
        self.matcher = LomaMatcher(descriptor, width)
        self.eval().requires_grad_(False)

    def encode(self, detected: Tensor, described: Tensor, number: int) -> LomaKeypoints:
        """Return up to ``number`` keypoints of one image, strongest first.

        The image is given at two sizes, for the detector and the descriptor, each (1, 3, H, W) RGB
        in 0..1.
        """
        (points,) = self.detector(detected, number)
        # Points are relative to the image's sides, so they need no conversion between the sizes.
        (descriptors,) = self.descriptor(described, points[None])
        return LomaKeypoints(points, descriptors)


def parameter_name(published: str) -> str:
    """Return our name of a published parameter.

    Names begin with ``_detector`` or ``_descriptor``; all others are the matcher's.
    """
    return published[1:] if published.startswith("_") else f"matcher.{published}"


def detector_size(image: Size, long_side: int) -> Size:
    """Return the detector's input size: ``image`` scaled to ``long_side``, in multiples of 8.

    Sides are rounded down. As in training, if rounding errors put the longer side just below
    ``long_side``, it loses 8 pixels: 685 pixels become 1016, not 1024.
    """
    scale = long_side / max(image)
    return Size(*(8 * int(scale * side / 8) for side in image))
