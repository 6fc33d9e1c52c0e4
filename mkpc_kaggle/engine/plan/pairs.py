"""The pairs of a run: the distinct ones, their batches, and extra pairs for scenes."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.store.scene_record import MIN_PAIRS
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs


def distinct_pairs(rows: Iterable[Pair]) -> tuple[list[Pair], NDArray[np.int_]]:
    """Return the distinct pairs of a table, the first row of each, and the pair of each row.

    Rows of a batch with the same two images are one pair: they share its points and its estimate.
    """
    pairs: list[Pair] = []
    known: dict[Any, int] = {}
    pair_of_row = []
    for pair in rows:
        # With other intrinsics, another E is estimated.
        intrinsics = pair.intrinsics and tuple(K.tobytes() for K in pair.intrinsics)
        key = (pair.group, pair.file0, pair.file1, pair.turns, intrinsics)
        if key not in known:
            known[key] = len(pairs)
            pairs.append(pair)
        pair_of_row.append(known[key])
    return pairs, np.array(pair_of_row, int)


def names_of(pair: Pair, root: str) -> tuple[str, str]:
    """Return the paths of a pair's images below ``root``."""
    return name_below(root, pair.file0), name_below(root, pair.file1)


def name_below(root: str, file: str) -> str:
    """Return a file's path relative to ``root``, or the whole path if the file lies elsewhere."""
    return file.removeprefix(root.rstrip("/") + "/") if root else file


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the pair indices of each batch that can be reconstructed: two or more pairs without
    intrinsics.
    """
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        # With known intrinsics, a pair gets an E, which no scene can replace.
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Return pairs that no row names, for the scenes of their batches, the most useful first.

    Each batch is filled up to ``pairs_per_image``, the batch with the fewest pairs per image first.
    """
    if config is None or not config.pairs_per_image:
        return []
    extra: list[tuple[float, Pair]] = []
    for batch, indices in batches_of(pairs).items():
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
