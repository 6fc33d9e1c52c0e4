"""RootSIFT with mutual nearest neighbours and the ratio test: classical, needs no weights.

Sources: Lowe 2004 (SIFT, as in OpenCV); Arandjelovic and Zisserman 2012 (RootSIFT).
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, SHARE, check_ranges
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Picture, Placement
from mkpc_kaggle.matchers.neighbours import NeighbourMatcher, Neighbours
from mkpc_kaggle.matchers.sparse import Keypoints
from mkpc_kaggle.weights import WeightStore


@dataclass(frozen=True)
class SiftOptions:
    """Settings of OpenCV's SIFT and of the ratio test."""

    features: int = 8000  # the strongest keypoints per picture
    ratio: float = 0.8  # the maximum distance ratio, in both directions
    contrast_threshold: float = 0.04  # OpenCV's default

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1, ratio=SHARE, contrast_threshold=AT_LEAST_0)


SPEC = MatcherSpec("sift", SiftOptions, Colour.GRAY, packages=("opencv",))
CORES_PER_PICTURE = 2
MAX_THREADS = 4  # each has a scale space of its picture in memory
Detected = tuple[Sequence[cv2.KeyPoint], NDArray[np.float32]]


class SiftMatcher(NeighbourMatcher):
    """OpenCV's SIFT. A match's score is one minus its distance ratio."""

    def __init__(self, options: SiftOptions, device: str) -> None:
        detector = partial(
            cv2.SIFT_create,  # type: ignore[attr-defined]  # missing in OpenCV's stubs
            options.features,
            contrastThreshold=options.contrast_threshold,
            # Without it, OpenCV shifts every point by a quarter of a pixel.
            enable_precise_upscale=True,
        )

        def keypoints_of(detection: Detected, picture: Picture) -> Keypoints:
            found, descriptors = detection
            points = np.array([keypoint.pt for keypoint in found], np.float32).reshape(-1, 2)
            return Keypoints.on_content(
                torch.from_numpy(points).to(device),
                torch.from_numpy(root_sift(descriptors)).to(device),
                picture.content,
            )

        def encode(pictures: Sequence[Picture]) -> list[Keypoints]:
            return list(map(keypoints_of, detected_in(pictures, detector), pictures))

        super().__init__(SPEC, encode, options.ratio)

    def _scores(self, pairs: Neighbours) -> Tensor:
        return 1 - pairs.ratio


def detected_in(pictures: Sequence[Picture], make: Callable[[], Any]) -> list[Detected]:
    """Return OpenCV's keypoints and descriptors (K, 128) of each picture, by detectors from ``make``.

    Several pictures at a time where there are cores for it, with the same results.
    """

    def detect(picture: Picture) -> Detected:
        found, descriptors = make().detectAndCompute(picture.pixels, None)
        if descriptors is None:  # OpenCV's value for no keypoints
            descriptors = np.zeros((0, 128), np.float32)
        return found, descriptors

    # OpenCV's own limit is this process's share of the cores. One picture keeps few of them busy.
    threads = min(MAX_THREADS, len(pictures), cv2.getNumThreads() // CORES_PER_PICTURE)
    if threads < 2:
        return [detect(picture) for picture in pictures]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(detect, pictures))


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Map SIFT descriptors (K, 128) to float32 unit vectors for the Hellinger kernel.

    The kernel is their dot product.
    """
    # A descriptor of zeros stays zero.
    tiny = np.finfo(np.float32).tiny
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), tiny)
    return np.asarray(np.sqrt(descriptors / sums), np.float32)


def load(weights: WeightStore, options: SiftOptions, placement: Placement) -> SiftMatcher:
    return SiftMatcher(options, placement.device)
