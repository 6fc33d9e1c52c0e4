"""SIFT keypoints (Lowe 2004, as in OpenCV) matched by LightGlue (Lindenberger et al. 2023)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn import functional

from mkpc_kaggle.matchers.adapters.sift import root_sift
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher, LightGlueOptions, load_glue
from mkpc_kaggle.matchers.sparse import Keypoints
from mkpc_kaggle.weights import WeightStore


@dataclass(frozen=True)
class SiftLightGlueOptions(LightGlueOptions):
    features: int = 4096  # as in the published evaluation


SHAPE = {"input_dim": 128, "add_scale_ori": True}
SPEC = MatcherSpec("sift_lightglue", SiftLightGlueOptions, Colour.GRAY, slots=("sift-lightglue",))
SHIFT_PX = 0.25  # OpenCV's offset without precise upscaling, which the published evaluation does not use


class SiftEncoder:
    """OpenCV's SIFT. Of several keypoints at one pixel, it keeps the highest response, then the smallest angle."""

    def __init__(self, features: int, device: str) -> None:
        self._features, self._device = features, device
        # Octave layers, contrast threshold and edge threshold as in the published evaluation.
        self._sift = cv2.SIFT_create(features, 4, 0.0066667, 10)  # type: ignore[attr-defined]  # missing in stubs

    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        return [self._encode(picture) for picture in pictures]

    def _encode(self, picture: Picture) -> Keypoints:
        found, descriptors = self._sift.detectAndCompute(picture.pixels, None)
        found = np.array([(*k.pt, k.size, np.radians(k.angle), k.response) for k in found]).reshape(-1, 5)
        order = np.lexsort((found[:, 3], -found[:, 4]))  # by descending response, then by angle
        _, first = np.unique(np.rint(found[order, :2] - 0.5), axis=0, return_index=True)
        kept = np.sort(order[np.sort(first)[: self._features]])
        x, y, sizes, angles, _ = torch.from_numpy(found[kept].astype(np.float32)).to(self._device).T
        roots = np.zeros((0, 128), np.float32) if descriptors is None else root_sift(descriptors[kept])
        unit = functional.normalize(torch.from_numpy(roots).to(self._device).clamp(min=1e-3), dim=1)
        return Keypoints.on_content(torch.stack([x, y], 1) - SHIFT_PX, unit, picture.content, sizes, angles)


def load(weights: WeightStore, options: SiftLightGlueOptions, placement: Placement) -> LightGlueMatcher:
    glue = load_glue(weights, "sift-lightglue", options.threshold, **SHAPE)
    return LightGlueMatcher(SPEC, SiftEncoder(options.features, placement.device), glue, placement)
