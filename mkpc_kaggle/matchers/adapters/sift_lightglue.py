"""SIFT keypoints (Lowe 2004, as in OpenCV) matched by LightGlue (Lindenberger et al. 2023)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from torch.nn import functional

from mkpc_kaggle.matchers.adapters.sift import Detected, detected_in, root_sift
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.sparse import Encode, Keypoints
from mkpc_kaggle.weights import WeightStore


@dataclass(frozen=True)
class SiftLightGlueOptions(LightGlueOptions):
    """LightGlue's settings, with more keypoints than for other detectors."""

    features: int = 4096  # as in the published evaluation


SHAPE = LightGlueShape(descriptor=128, positions=4)
SPEC = MatcherSpec(
    "sift_lightglue",
    SiftLightGlueOptions,
    Colour.GRAY,
    slots=("sift-lightglue",),
    packages=("opencv",),
)
SHIFT_PX = 0.25  # OpenCV's offset if precise upscaling is off, as in the published evaluation


def sift_encoder(features: int, device: str) -> Encode:
    """Return an encoder with OpenCV's SIFT.

    Of several keypoints at one pixel, keep the highest response; of equal responses, the smallest
    angle.
    """
    # Octave layers, contrast threshold and edge threshold as in the published evaluation.
    make = partial(cv2.SIFT_create, features, 4, 0.0066667, 10)  # type: ignore[attr-defined]

    def keypoints_of(detection: Detected, picture: Picture) -> Keypoints:
        detected, descriptors = detection
        rows = [
            (*keypoint.pt, keypoint.size, np.radians(keypoint.angle), keypoint.response)
            for keypoint in detected
        ]
        table = np.array(rows).reshape(-1, 5)

        # The first of each pixel in this order is the one to keep.
        # By descending response, then by angle
        order = np.lexsort((table[:, 3], -table[:, 4]))
        pixels = np.rint(table[order, :2] - 0.5)  # the published rounding
        _, first = np.unique(pixels, axis=0, return_index=True)
        kept = np.sort(order[np.sort(first)[:features]])  # the strongest, in OpenCV's order

        columns = torch.from_numpy(table[kept].astype(np.float32)).to(device).T
        x, y, sizes, angles, _ = columns
        points = torch.stack([x, y], 1) - SHIFT_PX
        roots = torch.from_numpy(root_sift(descriptors[kept])).to(device)
        # The published RootSIFT sets values below 1e-6 to 1e-6 before the square root.
        unit = functional.normalize(roots.clamp(min=1e-3), dim=1)
        return Keypoints.on_content(points, unit, picture.content, sizes, angles)

    def encode(pictures: Sequence[Picture]) -> list[Keypoints]:
        return list(map(keypoints_of, detected_in(pictures, make), pictures))

    return encode


def load(
    weights: WeightStore, options: SiftLightGlueOptions, placement: Placement
) -> LightGlueMatcher:
    encode = sift_encoder(options.features, placement.device)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
