"""SIFT keypoints (Lowe 2004, as in OpenCV) matched by LightGlue (Lindenberger et al. 2023)."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn import functional

from mkpc_kaggle.matchers.adapters.sift import root_sift
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_lightglue
from mkpc_kaggle.matchers.networks.lightglue import LightGlueShape
from mkpc_kaggle.matchers.sparse import Encode, Keypoints
from mkpc_kaggle.weights import WeightStore


@dataclass(frozen=True)
class SiftLightGlueOptions(LightGlueOptions):
    features: int = 4096  # as in the published evaluation


SHAPE = LightGlueShape(descriptor=128, positions=4)
SPEC = MatcherSpec("sift_lightglue", SiftLightGlueOptions, Colour.GRAY, slots=("sift-lightglue",))
SHIFT_PX = 0.25  # OpenCV's offset if precise upscaling is off, as in the published evaluation


def sift_encoder(features: int, device: str) -> Encode:
    """Return an encoder with OpenCV's SIFT.

    Of several keypoints at one pixel, keep the highest response; of equal responses, the smallest
    angle.
    """
    # Octave layers, contrast threshold and edge threshold as in the published evaluation.
    sift = cv2.SIFT_create(features, 4, 0.0066667, 10)  # type: ignore[attr-defined]  # missing in stubs

    def encode(picture: Picture) -> Keypoints:
        found, descriptors = sift.detectAndCompute(picture.pixels, None)
        found = np.array([(*k.pt, k.size, np.radians(k.angle), k.response) for k in found]).reshape(
            -1, 5
        )
        order = np.lexsort((found[:, 3], -found[:, 4]))  # by descending response, then by angle
        _, first = np.unique(np.rint(found[order, :2] - 0.5), axis=0, return_index=True)
        kept = np.sort(order[np.sort(first)[:features]])
        x, y, sizes, angles, _ = torch.from_numpy(found[kept].astype(np.float32)).to(device).T
        roots = (
            np.zeros((0, 128), np.float32) if descriptors is None else root_sift(descriptors[kept])
        )
        unit = functional.normalize(torch.from_numpy(roots).to(device).clamp(min=1e-3), dim=1)
        return Keypoints.on_content(
            torch.stack([x, y], 1) - SHIFT_PX, unit, picture.content, sizes, angles
        )

    return lambda pictures: list(map(encode, pictures))


def load(
    weights: WeightStore, options: SiftLightGlueOptions, placement: Placement
) -> LightGlueMatcher:
    encode = sift_encoder(options.features, placement.device)
    return load_lightglue(SPEC, encode, weights, options, placement, SHAPE)
