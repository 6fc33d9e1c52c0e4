"""Images that lie on a side: each is matched, turned, with the few that are most like it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.reconstruction.likeness import Partners

TURN_PARTNERS = 4  # with which an image is matched to see how it lies
MANY_INLIERS = 100  # with one of them: the image is the right way up
MIN_INLIERS = 30  # of an image that is turned
MIN_GAIN = 2.0  # times the inliers that it has as it is

Key = tuple[int, int, int]  # image i turned by so many quarters, and image j > i as it is
Inliers = Mapping[Key, int]


def relative(i: int, times: int, j: int) -> Key:
    """The key of image i turned by ``times`` quarters and image j as it is."""
    return (i, times % 4, j) if i < j else (j, -times % 4, i)


def upright_keys(partners: Partners, _: Inliers) -> list[Key]:
    """Every image with its partners, as they are."""
    return sorted({relative(i, 0, j) for i, others in enumerate(partners) for j in others})


def turned_keys(partners: Partners, found: Inliers) -> list[Key]:
    """The other three orientations of images that have few inliers with all of their partners."""
    few = [i for i, others in enumerate(partners) if _best(i, 0, others, found) < MANY_INLIERS]
    return sorted({relative(i, times, j) for i in few for times in (1, 2, 3) for j in partners[i]})


def turns_of(partners: Partners, found: Inliers) -> list[int]:
    """By how many quarters, counter-clockwise, each image has to be turned.

    An image that has few inliers as it is takes the best of the other three orientations if it gains enough; the
    turns of images before it count.
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
