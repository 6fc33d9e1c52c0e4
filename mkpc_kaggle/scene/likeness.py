"""The most similar images of each image of a large folder, by VLAD of RootSIFT.

RootSIFT needs no weights, works with dense matchers, and does not depend on the orientation of an
image. Source: Jegou et al. 2010; normalisation by Arandjelovic and Zisserman 2013.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.matchers.adapters.sift import root_sift

Descriptors = NDArray[np.uint8]  # (K, 128), ``SCALE`` times RootSIFT

PARTNERS = 20  # per image
WORDS = 64
SIDE_PX = 640
FEATURES = 1000  # descriptors per image
MAX_TRAINING = 50_000  # descriptors to cluster into words
COMPARED_AT_A_TIME = 1000  # images with all others
SCALE = np.float32(255)  # of descriptors as bytes


def local_features(path: Path) -> Descriptors:
    """Return the RootSIFT descriptors (K, 128) of an image; none if it is unreadable."""
    image = read_image(path)
    found = None
    # An unreadable image is reported when its pairs are matched.
    if isinstance(image, Image):
        scale = SIDE_PX / max(image.size)
        gray = cv2.resize(image.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        detector = cv2.SIFT_create(FEATURES)  # type: ignore[attr-defined]
        _, found = detector.detectAndCompute(gray, None)
    if found is None:
        return np.empty((0, 128), np.uint8)
    return np.asarray((SCALE * root_sift(found)).round(), np.uint8)


def shortlist(features: Sequence[Descriptors]) -> list[tuple[int, int]]:
    """Return the sorted, distinct pairs of each image and its ``PARTNERS`` most similar images, by their
    :func:`local_features`, each with the smaller index first.

    An image without features is equally similar to all, and gets the first ones.
    """
    words = _words(features)
    table = np.stack([vlad((found / SCALE).astype(np.float32), words) for found in features])
    pairs: set[tuple[int, int]] = set()
    # In parts: the similarities of all images of a large folder would fill the memory.
    for start in range(0, len(table), COMPARED_AT_A_TIME):
        similarity = table[start : start + COMPARED_AT_A_TIME] @ table.T
        own = np.arange(len(similarity))
        similarity[own, start + own] = -np.inf
        order = np.argsort(-similarity, axis=1, kind="stable")
        # The last one is the image itself.
        for image, others in enumerate(order[:, :-1][:, :PARTNERS].tolist(), start):
            pairs.update((min(image, other), max(image, other)) for other in others)
    return sorted(pairs)


def _words(features: Sequence[Descriptors]) -> NDArray[np.float32]:
    """Return the words (W, 128) of VLAD."""
    share = max(1, MAX_TRAINING // max(1, len(features)))
    training = (
        np.concatenate([found[:: max(1, len(found) // share)] for found in features]) / SCALE
    )
    # Evenly spread over the images, so that each kind of image has words
    words = training[:: max(1, len(training) // WORDS)][:WORDS]
    if len(words):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about words without descriptors
            words, _ = kmeans2(training, words, iter=10, minit="matrix")
    return np.asarray(words, np.float32)


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
