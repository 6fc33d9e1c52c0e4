"""Extra image pairs that densify the view graph of a batch whose images are in few pairs."""

from collections.abc import Sequence
from math import ceil
from typing import TypeAlias

import numpy as np

MAX_IMAGES = 2000  # the search takes the square of their number

Ends: TypeAlias = tuple[int, int]  # the two images of a pair by their indices, the smaller first


def extra_pairs(image_count: int, pairs: Sequence[Ends], per_image: float) -> list[Ends]:
    """The pairs that a batch lacks to have ``per_image`` pairs for each of its images, the most wanted first.

    ``pairs`` are those that it has, in any order. In each step the image in the fewest pairs gets a partner: the
    image that has most partners in common with it, since they are likely to show the same, and among these the
    image in the fewest pairs. Nothing for a batch of more than ``MAX_IMAGES``.
    """
    if image_count > MAX_IMAGES:
        return []
    linked = np.eye(image_count, dtype=bool)  # (N, N): an image is linked with its partners and with itself
    for first, second in pairs:
        linked[first, second] = linked[second, first] = True
    common = linked.astype(np.float32) @ linked.astype(np.float32)  # (N, N): partners in common; exact below 2**24
    degrees = linked.sum(1)
    wanted = min(ceil(per_image * image_count), image_count * (image_count - 1) // 2)
    extra: list[Ends] = []
    while (degrees.sum() - image_count) // 2 < wanted:
        image = int(np.where(degrees < image_count, degrees, image_count).argmin())
        likeness = np.where(linked[image], -np.inf, common[image] * image_count - degrees)
        partner = int(likeness.argmax())
        for here, there in ((image, partner), (partner, image)):
            theirs = linked[there].nonzero()[0]
            common[here, theirs] += 1
            common[theirs, here] += 1
        linked[image, partner] = linked[partner, image] = True
        degrees[[image, partner]] += 1
        extra.append((min(image, partner), max(image, partner)))
    return extra
