"""Pairs of images that may overlap, by RootSIFT: to match fewer pairs of a folder.

In a folder of different places, the few largest keypoints of two images show whether they may
overlap. In a large folder, VLAD descriptors give each image's most similar images.

All recipes use RootSIFT: it needs no weights, works with dense matchers, and does not depend on the
orientation of an image. Source: Jegou et al. 2010; normalisation by Arandjelovic and Zisserman
2013.
"""

import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.matchers.adapters.sift import root_sift
from mkpc_kaggle.matchers.neighbours import mutual_neighbours

PartnerIndices = list[list[int]]  # of each image, as indices of images

PARTNERS = 20  # per image
WORDS = 64
SIDE_PX = 640
FEATURES = 1000  # descriptors per image
MAX_TRAINING = 50_000  # descriptors to cluster into words
COMPARED_AT_A_TIME = 1000  # images with all others
FEATURE_SETTINGS = f"rootsift {SIDE_PX} {FEATURES} 1"  # ends with the version of the algorithm
# Of pairs with a covisibility of 0.1 to 0.2, 0.96 to 1.00 have this number of matches, and all pairs
# above. Of the pairs of different scenes, 0.30 have it (`python -m benchmarks.shortlists`).
MIN_LARGE_MATCHES = 4
LARGEST = 1000  # keypoints per image
LARGEST_SIDE_PX = 1024  # at 640, a pair of fountain_p11 with a covisibility above 0.3 is left out
DETECTED = 4000  # the strongest keypoints; the largest of them are kept
CONTRAST = 0.02
RATIO = 0.8
LARGEST_SETTINGS = (
    f"largest {LARGEST_SIDE_PX} {LARGEST} {DETECTED} {CONTRAST} {RATIO} {MIN_LARGE_MATCHES} 1"
)
# A folder is of one place, and all pairs are matched, if this share of the sampled pairs may overlap.
ONE_PLACE = 0.6
SAMPLED_PAIRS = 50
SCALE = np.float32(255)  # of descriptors stored as bytes


def shortlist(partners: PartnerIndices) -> list[tuple[int, int]]:
    """Return the sorted, distinct pairs of images and their partners, each with the smaller index
    first.
    """
    return sorted({(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others})


def local_features(path: Path) -> bytes:
    """Return the RootSIFT descriptors of an image, 128 bytes each; empty if the image is
    unreadable.
    """
    detector = cv2.SIFT_create(FEATURES)  # type: ignore[attr-defined]
    _, found = _detected(path, detector, SIDE_PX)
    return _packed(found)


def largest_features(path: Path) -> bytes:
    """Return the RootSIFT descriptors of an image's largest keypoints, as :func:`local_features`.

    Large keypoints are few, and are seen from any distance, so a small sample of them has matches.
    """
    detector = cv2.SIFT_create(DETECTED, contrastThreshold=CONTRAST)  # type: ignore[attr-defined]
    keypoints, found = _detected(path, detector, LARGEST_SIDE_PX)
    if found is None:
        return b""
    order = np.argsort([-keypoint.size for keypoint in keypoints], kind="stable")
    return _packed(found[order[:LARGEST]])


def overlapping(features: Sequence[bytes]) -> list[tuple[int, int]]:
    """Return the pairs of images that may overlap, by their :func:`largest_features`.

    These are all pairs if most of a random sample may overlap. An image without features is in all
    of its pairs: the matcher reports what is wrong with it.
    """
    descriptors = [torch.from_numpy(_unpacked(packed)) for packed in features]
    pairs = list(combinations(range(len(features)), 2))

    def may_overlap(pair: tuple[int, int]) -> bool:
        first, second = (descriptors[index] for index in pair)
        if not len(first) or not len(second):
            return True
        neighbours = mutual_neighbours(first, second, RATIO)
        return len(neighbours.index0) >= MIN_LARGE_MATCHES

    order = np.random.default_rng(0).permutation(len(pairs))[:SAMPLED_PAIRS]
    sample = [may_overlap(pairs[index]) for index in order]
    if np.mean(sample) >= ONE_PLACE:
        return pairs
    return [pair for pair in pairs if may_overlap(pair)]


def _detected(
    path: Path, detector: Any, side: int
) -> tuple[Sequence[Any], NDArray[np.float32] | None]:
    """Return the keypoints of an image with ``side`` pixels on its long side, and their descriptors
    (K, 128) or ``None``.
    """
    image = read_image(path)
    # An unreadable image is reported when its pairs are matched.
    if not isinstance(image, Image):
        return (), None
    scale = side / max(image.size)
    gray = cv2.resize(image.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, found = detector.detectAndCompute(gray, None)
    return keypoints, found


def _packed(descriptors: NDArray[np.float32] | None) -> bytes:
    """Return RootSIFT of descriptors (K, 128) as bytes."""
    if descriptors is None:
        return b""
    scaled = SCALE * root_sift(descriptors)
    return scaled.round().astype(np.uint8).tobytes()


def most_alike(features: Callable[[], Iterable[bytes]], count: int) -> list[list[int]]:
    """Return, for each image, the indices of the ``count`` images with the most similar
    :func:`local_features`.

    ``features`` is called once per pass, so it can stream. An image without features is similar to no other image.
    """
    count_images = sum(1 for _ in features())
    share = max(1, MAX_TRAINING // max(1, count_images))
    parts = []
    for found in map(_unpacked, features()):
        step = max(1, len(found) // share)
        parts.append(found[::step])
    training = np.concatenate(parts)
    # Evenly spread over the images, so that each kind of image has words
    step = max(1, len(training) // WORDS)
    words = training[::step][:WORDS]
    if len(words):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about words without descriptors
            words, _ = kmeans2(training, words, iter=10, minit="matrix")
    table = np.stack([vlad(found, words) for found in map(_unpacked, features())])
    near: list[list[int]] = []
    # In parts: the similarities of all images of a large folder would fill the memory.
    for start in range(0, len(table), COMPARED_AT_A_TIME):
        similarity = table[start : start + COMPARED_AT_A_TIME] @ table.T
        own = np.arange(len(similarity))
        similarity[own, start + own] = -np.inf
        order = np.argsort(-similarity, axis=1, kind="stable")
        # The last one is the image itself.
        near += order[:, :-1][:, :count].tolist()
    return near


def _unpacked(features: bytes) -> NDArray[np.float32]:
    """Return the (K, 128) descriptors."""
    return np.frombuffer(features, np.uint8).reshape(-1, 128).astype(np.float32) / SCALE


def vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the unit-length VLAD (W * D,) of descriptors (K, D) over words (W, D); zeros if K is
    0.
    """
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest, _ = vq(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    # A word without descriptors has length 0.
    sums /= np.maximum(lengths, np.finfo(np.float32).tiny)
    flat = np.sign(sums) * np.sqrt(np.abs(sums))
    length = max(float(np.linalg.norm(flat)), 1e-12)
    return np.asarray(flat.ravel() / length, np.float32)
