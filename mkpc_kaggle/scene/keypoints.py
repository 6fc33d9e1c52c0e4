"""Keypoints of images from the matches of their pairs: a point that two pairs share becomes one keypoint.

Matchers find a point again to within a fraction of a pixel only, when they see it in another pair, at another
resolution, or when it is another matcher's. Structure from motion follows points through images, so the points of
an image that are less than a pixel apart have to be one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Points
from mkpc_kaggle.scene.batch import Edge


@dataclass(frozen=True, eq=False)
class EdgeKeypoints:
    """Matches between the keypoints of two images: ``index`` is (M, 2) uint32, their places."""

    first: int
    second: int
    index: NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class SceneKeypoints:
    """``points``: of each image, (K, 2) float32 in image pixels; ``edges``: which of them match, pair by pair."""

    points: tuple[Points, ...]
    edges: tuple[EdgeKeypoints, ...]


def scene_keypoints(image_count: int, edges: Sequence[Edge], cell: float) -> SceneKeypoints:
    """The keypoints of ``image_count`` images and the matches between them; ``cell`` is in pixels."""
    parts: list[list[Points]] = [[np.zeros((0, 2), np.float32)] for _ in range(image_count)]
    for edge in edges:
        parts[edge.first].append(edge.matches.points0)
        parts[edge.second].append(edge.matches.points1)
    merged = [merge_points(np.concatenate(part), cell) for part in parts]
    places = [cut_like(place, part) for (_, place), part in zip(merged, parts, strict=True)]
    matched = [np.stack([next(places[edge.first]), next(places[edge.second])], axis=1) for edge in edges]
    return SceneKeypoints(
        tuple(points for points, _ in merged),
        tuple(
            EdgeKeypoints(edge.first, edge.second, one_to_one(index))
            for edge, index in zip(edges, matched, strict=True)
        ),
    )


def cut_like(place: NDArray[np.intp], parts: Sequence[Points]) -> Iterator[NDArray[np.intp]]:
    """``place`` cut into the lengths of ``parts``, without the empty one that they begin with."""
    ends = np.cumsum([len(part) for part in parts])
    return iter(np.split(place, ends[:-1])[1:])


def merge_points(points: Points, cell: float) -> tuple[Points, NDArray[np.intp]]:
    """(N, 2) points -> (K, 2) float32 means of those that share a cell, and for each point its place there, (N,).

    A grid has borders, and a point on one would be in either cell: the means of a first grid are merged once more
    in a second one, shifted by half a cell.
    """
    total: NDArray[np.float64] = points.astype(np.float64)
    weight: NDArray[np.float64] = np.ones(len(points))
    place: NDArray[np.intp] = np.arange(len(points))
    for shift in (0.0, 0.5):
        cells = np.floor(total / weight[:, None] / cell + shift).astype(np.int64)
        distinct, inverse = np.unique(cells, axis=0, return_inverse=True)
        inverse = inverse.ravel()
        total, weight = sums(total, inverse, len(distinct)), sums(weight, inverse, len(distinct))
        place = inverse[place]
    return (total / weight[:, None]).astype(np.float32), place


def sums(values: NDArray[np.float64], group: NDArray[np.intp], count: int) -> NDArray[np.float64]:
    """The sum of the values (N, ...) of each of ``count`` groups, (count, ...)."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, group, values)
    return total


def one_to_one(index: NDArray[np.intp]) -> NDArray[np.uint32]:
    """(N, 2) pairs of keypoints -> (M, 2) in which no keypoint is twice.

    Pairs that were found more often go first, then earlier ones: matchers that disagree about a keypoint cannot
    both be right.
    """
    distinct, first, count = np.unique(index, axis=0, return_index=True, return_counts=True)
    order = np.lexsort((first, -count))
    taken0: set[int] = set()
    taken1: set[int] = set()
    kept = []
    for number in order:
        i, j = distinct[number].tolist()
        if i not in taken0 and j not in taken1:
            taken0.add(i)
            taken1.add(j)
            kept.append(number)
    return distinct[np.sort(np.array(kept, np.intp))].astype(np.uint32).reshape(-1, 2)
