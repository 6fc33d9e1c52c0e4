"""Edges to trust: matches between similar sides of an object verify each other, but are few.

Two sides of a temple, or two windows, have matches that agree with one fundamental matrix, so
verification keeps the edge. It has far fewer inliers than the edges of the same images that are
right. The global mapper averages all edges, and a few wrong ones bend its cameras.
"""

from collections import defaultdict
from collections.abc import Sequence

# The support of an image is the number of inliers of its edge of this rank. A single edge may join
# copies of one photograph, and says nothing about the others.
RANK = 3


def supported(ends: Sequence[tuple[int, int]], inliers: Sequence[int], share: float) -> list[bool]:
    """Return for each edge if it has at least ``share`` of the support of both of its images.

    ``ends`` are the indices of an edge's images, ``inliers`` its verified matches.
    """
    counts: dict[int, list[int]] = defaultdict(list)
    for images, count in zip(ends, inliers, strict=True):
        for image in images:
            counts[image].append(count)
    support = {}
    for image, found in counts.items():
        found.sort(reverse=True)
        support[image] = found[:RANK][-1]
    return [
        count >= share * max(support[image] for image in images)
        for images, count in zip(ends, inliers, strict=True)
    ]
