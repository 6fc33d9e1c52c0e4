"""Extra pairs that densify the view graph of a batch with few pairs per image.

In the phase *Connect*, the engine matches them by the recipe's first unit alone, without an F, for a tenth of
the time. `reconstruct` has no extra pairs: it sets ``pairs_per_image`` of [scene] to 0.
"""

from collections.abc import Sequence
from math import ceil
from typing import TypeAlias

import numpy as np

MAX_IMAGES = 2000  # the search is quadratic in the number of images

IndexPair: TypeAlias = tuple[int, int]  # indices of a pair's two images, the smaller first


def extra_pairs(image_count: int, pairs: Sequence[IndexPair], per_image: float) -> list[IndexPair]:
    """Return extra pairs that give a batch ``per_image`` pairs per image, the most useful first.

    ``pairs`` are the existing pairs, in any order. Each step links the image in the fewest pairs to the image with
    the most partners in common. The two probably show the same part of the scene. Ties go to the image in the
    fewest pairs. A batch of more than ``MAX_IMAGES`` images gets no extra pairs.
    """
    if image_count > MAX_IMAGES:
        return []
    # (N, N); each image is linked to its partners and itself
    linked = np.eye(image_count, dtype=bool)
    for first, second in pairs:
        linked[first, second] = linked[second, first] = True
    # (N, N): partners in common; exact below 2**24
    common = linked.astype(np.float32) @ linked.astype(np.float32)
    degrees = linked.sum(1)
    all_pairs = image_count * (image_count - 1) // 2
    wanted = min(ceil(per_image * image_count), all_pairs)
    extra: list[IndexPair] = []
    while (degrees.sum() - image_count) // 2 < wanted:
        image = int(np.where(degrees < image_count, degrees, image_count).argmin())
        # Partners in common decide, and degrees only between equals.
        likeness = common[image] * image_count - degrees
        likeness = np.where(linked[image], -np.inf, likeness)
        partner = int(likeness.argmax())
        for here, there in ((image, partner), (partner, image)):
            theirs = linked[there].nonzero()[0]
            common[here, theirs] += 1
            common[theirs, here] += 1
        linked[image, partner] = linked[partner, image] = True
        degrees[[image, partner]] += 1
        extra.append((min(image, partner), max(image, partner)))
    return extra
