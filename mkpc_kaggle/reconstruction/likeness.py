"""Which images look alike, by a VLAD of RootSIFT: the pairs of a large folder, and images that lie on a side.

RootSIFT whatever the recipe is: it needs no weights, is there for dense matchers, too, and does not care how an
image is turned. Source: Jegou et al. 2010; normalisation by Arandjelovic and Zisserman 2013.
"""

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.geometry.robust import estimate
from mkpc_kaggle.matchers.adapters.sift import root_sift
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.pair import PairMatch

PARTNERS = 20  # of an image
WORDS = 64
SIDE_PX = 640
FEATURES = 1000
MAX_TRAINING = 50_000  # descriptors that the words are made of
THREADS = 4  # OpenCV releases the interpreter's lock

TURN_PARTNERS = 4  # with which an image is matched to see how it lies
MANY_INLIERS = 100  # with one of them: the image is the right way up
MIN_INLIERS = 30  # of an image that is turned
MIN_GAIN = 2.0  # times the inliers that it has as it is


def shortlist(files: Sequence[Path], partners: int = PARTNERS) -> list[tuple[int, int]]:
    """Pairs of indices of ``files``, smaller first, in order: each image with the ``partners`` most like it."""
    near = enumerate(most_alike(files, partners))
    return sorted({(min(i, j), max(i, j)) for i, others in near for j in others})


def most_alike(files: Sequence[Path], count: int) -> list[list[int]]:
    """For each image the indices of the others that are most like it; unreadable images are like no other."""
    with ThreadPoolExecutor(THREADS) as pool:
        descriptors = list(pool.map(local_features, files))
    every = np.concatenate(descriptors)
    training = every[np.sort(np.random.default_rng(0).permutation(len(every))[:MAX_TRAINING])]
    words = training[:: max(1, len(training) // WORDS)][:WORDS]
    if len(words):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a word that nothing is near to any more
            words, _ = kmeans2(training, words, iter=10, minit="matrix")
    table = np.stack([vlad(found, words) for found in descriptors])
    similarity = table @ table.T
    np.fill_diagonal(similarity, -np.inf)
    near: list[list[int]] = np.argsort(-similarity, axis=1, kind="stable")[:, :-1][:, :count].tolist()
    return near


def local_features(path: Path) -> NDArray[np.float32]:
    """(K, 128) RootSIFT of an image; none of an image that cannot be read."""
    image, found = read_image(path), None
    if isinstance(image, Image):
        scale = SIDE_PX / max(image.size)
        gray = cv2.resize(image.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        _, found = cv2.SIFT_create(FEATURES).detectAndCompute(gray, None)  # type: ignore[attr-defined]
    return np.zeros((0, 128), np.float32) if found is None else root_sift(found)


def vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, D) descriptors and (W, D) words -> (W * D,) of unit length, or zero without descriptors."""
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest, _ = vq(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    flat = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(flat.ravel() / max(float(np.linalg.norm(flat)), 1e-12), np.float32)


def find_turns(files: Sequence[Path], assembly: Assembly) -> dict[Path, int]:
    """By how many quarters, counter-clockwise, images have to be turned that match little as they are.

    The recipe's first unit matches each image with the few that are most like it. An image that has few inliers
    with all of them is tried in the three other orientations, of which the best is taken if it gains enough.
    """
    pipeline, turns = assembly.pipeline(), dict[Path, int]()

    def inliers(path: Path, times: int, partners: Sequence[Path]) -> int:
        image, others = turned(path, times), (turned(other, turns.get(other, 0)) for other in partners)
        pairs = [PairMatch(images=(image, other)) for other in others if image and other]
        matched = pipeline.match(pairs, assembly.recipe.units[:1])
        return max((estimate(pair.matches, assembly.recipe.magsac).inlier_count for pair in matched), default=0)

    for path, near in zip(files, most_alike(files, TURN_PARTNERS), strict=True):
        partners = [files[index] for index in near]
        if (upright := inliers(path, 0, partners)) < MANY_INLIERS:
            counts = {times: inliers(path, times, partners) for times in (1, 2, 3)}
            best = max(counts, key=counts.__getitem__)
            if counts[best] >= max(MIN_INLIERS, MIN_GAIN * upright):
                turns[path] = best
    return turns


def turned(path: Path, times: int) -> Image | None:
    """An image turned by so many quarters; ``None`` if it cannot be read."""
    image = read_image(path)
    if not isinstance(image, Image):
        return None
    return Image(f"{path} {times}", np.ascontiguousarray(np.rot90(image.pixels, times)))
