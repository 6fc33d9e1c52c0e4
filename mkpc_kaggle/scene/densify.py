"""Extra pairs, which no row names: they densify the view graph of a batch with few pairs per image.

- Which: :func:`extra_pairs_of` fills each batch of up to 2,000 images, with two or more pairs, up to
  ``pairs_per_image`` times as many pairs as images. This number of [scene] is 10 by default; `reconstruct` sets
  it to 0. The image in the fewest pairs is next, with the image that shares most partners.
- How: matched by the unit of the sweep alone, the recipe's first one of stage 1 that can run, and without an F,
  because they serve scenes alone.
- When: with [scene], in the phase *Connect*, after the sweep and before any other unit, for up to a tenth of the
  time that is left then (:attr:`mkpc_kaggle.engine.plan.Plan.extra`). Pairs of the sparsest
  batches are kept first.
"""

from collections.abc import Iterable, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.recipe import SceneConfig

MIN_PAIRS = 2  # of a batch that is reconstructed: the minimum to connect three images
MAX_IMAGES = 2000  # the search is quadratic in the number of images

IndexPair: TypeAlias = tuple[int, int]  # indices of a pair's two images, the smaller first


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the pair indices of each batch that can be reconstructed, of two or more pairs."""
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(
    pairs: Sequence[Pair], batches: Mapping[str, Sequence[int]], config: SceneConfig | None
) -> list[Pair]:
    """Return the extra pairs of all batches, the most useful first.

    ``batches`` has the indices of each batch's pairs. The batch with the fewest pairs per image is filled first.
    """
    if config is None or not config.pairs_per_image:
        return []
    extra: list[tuple[float, Pair]] = []
    for batch, indices in batches.items():
        number: dict[str, int] = {}  # of each image in its batch
        ends = []
        for index in indices:
            pair = pairs[index]
            i = number.setdefault(pair.file0, len(number))
            j = number.setdefault(pair.file1, len(number))
            ends.append((i, j))
        files = list(number)
        distinct = len({tuple(sorted(pair)) for pair in ends})
        more = extra_pairs(len(files), ends, config.pairs_per_image)
        for count, (i, j) in enumerate(more, start=distinct):
            name = f"{batch};{Path(files[i]).stem}-{Path(files[j]).stem}"
            pair = Pair(name, batch, files[i], files[j])
            # Pairs per image of the batch before this pair is added: the order of all batches.
            extra.append((count / len(files), pair))
    return [pair for _, pair in sorted(extra, key=lambda each: each[0])]


def extra_pairs(
    image_count: int, pairs: Sequence[IndexPair], per_image: float
) -> list[IndexPair]:
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
