"""The pairs of each batch, and extra pairs that densify the view graph of a batch with few pairs per image."""

from collections.abc import Iterable, Sequence
from math import ceil
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.recipe import SceneConfig

MIN_PAIRS = 2  # they can connect three images
MAX_IMAGES = 2000  # the search is quadratic in their number

Ends: TypeAlias = tuple[int, int]  # the two images of a pair by their indices, the smaller first


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the indices of the pairs of each batch that may be reconstructed: F is wanted, no camera is known."""
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Return pairs of a batch's images that no row names, for its scene alone; the most useful first.

    Each batch gets up to ``pairs_per_image``, the batch with the fewest pairs per image first.
    """
    if config is None or not config.pairs_per_image:
        return []
    extra: list[tuple[float, Pair]] = []
    for batch, indices in batches_of(pairs).items():
        asked = [pairs[index] for index in indices]
        files = list(dict.fromkeys(file for pair in asked for file in (pair.file0, pair.file1)))
        number = {file: index for index, file in enumerate(files)}
        ends = [(number[pair.file0], number[pair.file1]) for pair in asked]
        distinct = len({tuple(sorted(pair)) for pair in ends})
        for count, (i, j) in enumerate(extra_pairs(len(files), ends, config.pairs_per_image), start=distinct):
            key = f"{batch};{Path(files[i]).stem}-{Path(files[j]).stem}"
            extra.append((count / len(files), Pair(key, batch, files[i], files[j])))
    return [pair for _, pair in sorted(extra, key=lambda each: each[0])]


def extra_pairs(image_count: int, pairs: Sequence[Ends], per_image: float) -> list[Ends]:
    """Return extra pairs that give a batch ``per_image`` pairs per image, the most useful first.

    ``pairs`` are the existing pairs, in any order. Each step adds a partner to the image in the fewest pairs: the
    image with the most partners in common, which probably shows the same part of the scene. Among several, the
    image in the fewest pairs wins. A batch of more than ``MAX_IMAGES`` images gets none.
    """
    if image_count > MAX_IMAGES:
        return []
    linked = np.eye(image_count, dtype=bool)  # (N, N); each image is linked to its partners and itself
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
