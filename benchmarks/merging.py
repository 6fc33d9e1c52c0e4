"""Points that several units find again: merged into one match each."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from mkpc_kaggle.geometry.matches import Matches


def merged(parts: Sequence[Matches], radius: float) -> Matches:
    """The parts one after the other, less every match that repeats a kept one of another part.

    One match repeats another if its points lie no more than ``radius`` pixels apart, in x and in y and in both
    images. The first stays.
    """
    together = Matches.concatenate(parts)
    if len(together) == 0:
        return together
    part = np.repeat(np.arange(len(parts)), [len(matches) for matches in parts])
    points = np.hstack([together.points0, together.points1]).astype(np.float64)
    near = KDTree(points).query_pairs(radius, p=np.inf, output_type="ndarray")
    near = near[part[near[:, 0]] != part[near[:, 1]]]
    kept = np.ones(len(together), bool)
    # In the order of the earlier of the two: whether that one stays is then settled.
    for earlier, later in near[np.lexsort((near[:, 1], near[:, 0]))].tolist():
        if kept[earlier]:
            kept[later] = False
    return together[kept]
