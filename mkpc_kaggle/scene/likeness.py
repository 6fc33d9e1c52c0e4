"""Similarity of images by VLAD descriptors of RootSIFT, to choose each image's partners in a large
folder.

All recipes use RootSIFT: it needs no weights, works with dense matchers, and does not depend on the
orientation of an image. Source: Jegou et al. 2010; normalisation by Arandjelovic and Zisserman
2013.
"""

import warnings
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.matchers.adapters.sift import root_sift

Partners = list[list[int]]  # of each image, as indices of images

PARTNERS = 20  # per image
WORDS = 64
SIDE_PX = 640
FEATURES = 1000  # descriptors per image
MAX_TRAINING = 50_000  # descriptors to cluster into words
FEATURE_SETTINGS = f"rootsift {SIDE_PX} {FEATURES} 1"  # ends with the version of the algorithm
SCALE = np.float32(255)  # of descriptors stored as bytes


def shortlist(partners: Partners) -> list[tuple[int, int]]:
    """Return the sorted, distinct pairs of images and their partners, each with the smaller index
    first.
    """
    return sorted({(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others})


def local_features(path: Path) -> bytes:
    """Return the RootSIFT descriptors of an image, 128 bytes each; empty if the image is
    unreadable.
    """
    image = read_image(path)
    found = None
    # An unreadable image is reported when its pairs are matched.
    if isinstance(image, Image):
        scale = SIDE_PX / max(image.size)
        gray = cv2.resize(image.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        _, found = cv2.SIFT_create(FEATURES).detectAndCompute(gray, None)  # type: ignore[attr-defined]
    if found is None:
        return b""
    scaled = SCALE * root_sift(found)
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
    similarity = table @ table.T
    np.fill_diagonal(similarity, -np.inf)
    order = np.argsort(-similarity, axis=1, kind="stable")
    # The last one is the image itself.
    near: list[list[int]] = order[:, :-1][:, :count].tolist()
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
