"""Keypoints of images, merged from the matches of all pairs: points less than a pixel apart are one
keypoint.

The position of a point varies by a fraction of a pixel between pairs, resolutions and matchers.
Structure from motion tracks a point through several pairs, so its positions in an image must become
one keypoint.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Points
from mkpc_kaggle.scene.view_graph import ViewGraph

CELL_PX = 0.75  # points of an image in one cell of this size are one keypoint


# (M, 2): indices of the matched keypoints in both images of an edge
Index = NDArray[np.uint32]


class Lens(NamedTuple):
    """The part of a camera that verification depends on: COLMAP's model, the other parameters, and the
    mean focal length in pixels.
    """

    model: Any
    others: tuple[float, ...]
    focal: float


class MergedGraph:
    """A view graph with the keypoints of its images, and all that was computed from these.

    The same graph is reconstructed with separate and with shared intrinsics, and then exported. So
    keypoints are merged once, and ``geometries`` has the two-view geometries that are verified so
    far, by the number of their edge and by its two cameras.
    """

    def __init__(self, graph: ViewGraph) -> None:
        self.graph = graph
        self.geometries: dict[int, dict[tuple[Lens, Lens], Any]] = {}

    @property
    def keypoints(self) -> list[Points]:
        """The keypoints (K, 2) of each image."""
        return self._merged[0]

    @property
    def matches(self) -> list[Index]:
        """The matches (M, 2) of each edge, as indices of keypoints."""
        return self._merged[1]

    # A graph that is too small to be reconstructed needs none.
    @cached_property
    def _merged(self) -> tuple[list[Points], list[Index]]:
        return scene_keypoints(self.graph)


def scene_keypoints(graph: ViewGraph) -> tuple[list[Points], list[Index]]:
    """Return the keypoints of each image, (K, 2) float32 in image pixels, and the matches of each
    edge.
    """
    # The points of each image, edge by edge
    parts: list[list[Points]] = [[] for _ in graph.images]
    for edge in graph.edges:
        parts[edge.first].append(edge.matches.points0)
        parts[edge.second].append(edge.matches.points1)
    keypoints = []
    indices = []
    nothing = np.zeros((0, 2), np.float32)  # of an image without matches
    for part in parts:
        points, index = merge_points(np.concatenate([nothing, *part]), CELL_PX)
        keypoints.append(points)
        ends = np.cumsum([len(some) for some in part])[:-1]
        indices.append(iter(np.split(index, ends)))
    # The same order as above, so the next part of an image belongs to this edge.
    matches = [
        np.stack([next(indices[edge.first]), next(indices[edge.second])], axis=1)
        for edge in graph.edges
    ]
    return keypoints, list(map(one_to_one, matches))


def merge_points(points: Points, cell: float) -> tuple[Points, NDArray[np.intp]]:
    """Return each cell's float32 mean (K, 2) of the points (N, 2), and the index (N,) of each
    point's mean.

    A grid separates close points on the two sides of a cell border. So a second grid, shifted by
    half a cell, merges the means from the first grid.
    """
    total: NDArray[np.float64] = points.astype(np.float64)
    weight: NDArray[np.float64] = np.ones(len(points))
    index: NDArray[np.intp] = np.arange(len(points))
    for shift in (0.0, 0.5):
        cells = np.floor(total / weight[:, None] / cell + shift).astype(np.int64)
        distinct, inverse = np.unique(numbers_of(cells), return_inverse=True)
        count = len(distinct)
        sums = [np.bincount(inverse, column, count) for column in total.T]
        total = np.column_stack(sums)
        weight = np.bincount(inverse, weight, count).astype(np.float64)
        index = inverse[index]
    return (total / weight[:, None]).astype(np.float32), index


def one_to_one(index: NDArray[np.intp]) -> Index:
    """Select matches (M, 2) of (N, 2) so that each keypoint is used at most once.

    Of conflicting matches, at most one is correct. The more frequent match wins, then the earlier
    one.
    """
    _, first, count = np.unique(numbers_of(index), return_index=True, return_counts=True)
    distinct = index[first]
    # Most matches share no keypoint with another one; only conflicts are decided one by one.
    is_free = np.ones(len(distinct), bool)
    for column in distinct.T:
        is_free &= np.bincount(column)[column] == 1
    conflicts = np.flatnonzero(~is_free)
    # The last key is the first to sort by.
    order = conflicts[np.lexsort((first[conflicts], -count[conflicts]))]
    taken0: set[int] = set()
    taken1: set[int] = set()
    kept = np.flatnonzero(is_free).tolist()
    for number in order.tolist():
        i, j = distinct[number].tolist()
        if i not in taken0 and j not in taken1:
            taken0.add(i)
            taken1.add(j)
            kept.append(number)
    chosen = np.sort(np.array(kept, np.intp))
    return distinct[chosen].astype(np.uint32).reshape(-1, 2)


def numbers_of(rows: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return a number (N,) for each row (N, 2) of integers; numbers are equal and ordered as rows.

    NumPy sorts numbers ten times faster than rows.
    """
    if not len(rows):
        return np.zeros(0, np.int64)
    rows = rows.astype(np.int64)
    low = rows.min(axis=0)
    width = int(rows[:, 1].max() - low[1]) + 1
    return np.asarray((rows[:, 0] - low[0]) * width + (rows[:, 1] - low[1]))
