"""Orientation of images, found by matching each image in four rotations with its most similar images."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.reconstruction.likeness import Partners

TURN_PARTNERS = 4  # per image, to find its orientation
MANY_INLIERS = 100  # with one partner: the image is upright
MIN_INLIERS = 30  # of a turned image
MIN_GAIN = 2.0  # of inliers, relative to the unturned image

Key = tuple[int, int, int]  # image i, its quarter turns, and the unturned image j > i
Inliers = Mapping[Key, int]


def relative(i: int, times: int, j: int) -> Key:
    """Return the key of image i turned by ``times`` quarters and the unturned image j."""
    return (i, times % 4, j) if i < j else (j, -times % 4, i)


def upright_keys(partners: Partners, _: Inliers) -> list[Key]:
    """Return the keys of every unturned image with its partners."""
    return sorted({relative(i, 0, j) for i, others in enumerate(partners) for j in others})


def turned_keys(partners: Partners, found: Inliers) -> list[Key]:
    """Return the keys of the other three orientations, for images with few inliers with all partners."""
    few = [i for i, others in enumerate(partners) if _best(i, 0, others, found) < MANY_INLIERS]
    return sorted({relative(i, times, j) for i in few for times in (1, 2, 3) for j in partners[i]})


def turns_of(partners: Partners, found: Inliers) -> list[int]:
    """Return the counter-clockwise quarter turns that set each image upright.

    An image with few inliers takes the best of the other three orientations if it gains enough, relative to the
    turns of earlier images.
    """
    turns = [0] * len(partners)
    for i, others in enumerate(partners):
        counts = [max((_best(i, times - turns[j], [j], found) for j in others), default=0) for times in range(4)]
        best = max(range(4), key=counts.__getitem__)
        if counts[0] < MANY_INLIERS and counts[best] >= max(MIN_INLIERS, MIN_GAIN * counts[0]):
            turns[i] = best
    return turns


def _best(i: int, times: int, others: Sequence[int], found: Inliers) -> int:
    return max((found.get(relative(i, times, j), 0) for j in others), default=0)


def pair_of(key: Key, dataset: str, files: Sequence[Path]) -> Pair:
    i, times, j = key
    ends = str(files[i]), str(files[j])
    return Pair(f"{dataset}/{files[i].stem} turned {times}/{files[j].stem}", dataset, *ends, turns=(times, 0))
