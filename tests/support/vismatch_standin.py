"""An object with the interface of vismatch's matchers: OpenCV's ORB, in the coordinates that are asked for."""

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor


class OrbLikeVismatch(torch.nn.Module):
    """``offset``: where the centre of the top-left pixel is; ``confident``: whether it tells confidences."""

    def __init__(self, offset: float = 0.0, *, confident: bool = True) -> None:
        super().__init__()
        self.offset = offset
        self.confident = confident
        self.skip_ransac = False
        self.seen: list[Tensor] = []

    def forward(self, img0: Tensor, img1: Tensor) -> dict[str, Any]:
        self.seen += [img0, img1]
        (points0, words0), (points1, words1) = map(self.detected, (img0, img1))
        pairs = []
        if len(points0) > 0 and len(points1) > 0:
            pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words0, words1)
        confidences = np.array([1 - pair.distance / 256 for pair in pairs], np.float32)
        assert self.skip_ransac, "a homography would be fitted to the matches"
        return {
            "num_inliers": 0,
            "H": None,
            "all_kpts0": points0,
            "all_kpts1": points1,
            "matched_kpts0": points0[[pair.queryIdx for pair in pairs]],
            "matched_kpts1": points1[[pair.trainIdx for pair in pairs]],
            "inlier_kpts0": np.empty((0, 2)),
            "inlier_kpts1": np.empty((0, 2)),
            "matched_confidences": confidences if self.confident else None,
        }

    def detected(self, image: Tensor) -> tuple[np.ndarray, np.ndarray]:
        assert image.dtype == torch.float32
        assert image.shape[0] == 3
        gray = cv2.cvtColor((255 * image).round().byte().permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
        found, words = cv2.ORB_create(1000).detectAndCompute(gray, None)
        points = np.array([keypoint.pt for keypoint in found], np.float32).reshape(-1, 2)
        return points + self.offset, np.zeros((0, 32), np.uint8) if words is None else words
