"""Nearest neighbours of descriptors by lists: a few similar ones of all keys are compared.

The descriptors of an image are divided by k-means into lists. A query is compared with the keys of
the lists whose centroids are nearest. Source: Jegou et al. 2011 (inverted file).
"""

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor
from torch.nn.functional import normalize

LISTS_PER_ROOT = 0.7  # lists of N descriptors, over the square root of N
PROBES = 12  # lists that a query is compared with
KMEANS_STEPS = 4
MAX_TRAINING = 4000  # descriptors for k-means


class Search(StrEnum):
    """How the nearest neighbours of descriptors are found."""

    EXACT = "exact"
    LISTS = "lists"  # on a CPU, of pictures with at least 3,000 keypoints


@dataclass(frozen=True, eq=False)
class Lists:
    """The lists of N descriptors that are sorted by list.

    The first ``sizes[0]`` descriptors are near ``centroids[0]``, and so on. ``centroids`` (C, D)
    are unit vectors, ``sizes`` (C,) int64; no list is empty.
    """

    centroids: Tensor
    sizes: Tensor


@dataclass(frozen=True)
class Nearest:
    """The nearest keys of M of the queries.

    ``query`` (M,) int64, ascending, and ``key`` (M,) int64 are indices. ``similarity`` (M,) are
    cosines, ``ratio`` (M,) the nearest over the second nearest distance.
    """

    query: Tensor
    key: Tensor
    similarity: Tensor
    ratio: Tensor


def make_lists(descriptors: Tensor) -> tuple[Tensor, Lists]:
    """Return the order (N,) that sorts unit descriptors (N, D) by list, and their lists.

    The same descriptors in the same order give the same lists. N is at least 1.
    """
    count = max(1, round(LISTS_PER_ROOT * len(descriptors) ** 0.5))
    step = -(-len(descriptors) // MAX_TRAINING)
    centroids = kmeans(descriptors[::step], count)
    nearest = (descriptors @ centroids.T).argmax(dim=1)
    sizes = torch.bincount(nearest, minlength=count)
    is_used = sizes > 0
    return nearest.argsort(stable=True), Lists(centroids[is_used], sizes[is_used])


def kmeans(descriptors: Tensor, count: int) -> Tensor:
    """Return up to ``count`` centroids, unit vectors (C, D), after a few of Lloyd's steps."""
    # Neighbours in an image are alike, so the first centroids are spread over its keypoints.
    step = max(1, len(descriptors) // count)
    centroids = descriptors[::step][:count].clone()
    for _ in range(KMEANS_STEPS):
        nearest = (descriptors @ centroids.T).argmax(dim=1)
        sums = torch.zeros_like(centroids).index_add_(0, nearest, descriptors)
        is_empty = (sums == 0).all(dim=1, keepdim=True)
        centroids = normalize(torch.where(is_empty, centroids, sums), dim=1)
    return centroids


def nearest_in_lists(queries: Tensor, keys: Tensor, lists: Lists, max_ratio: float) -> Nearest:
    """Return the nearest of the keys (N, D), which are sorted by list, to each of the queries (M, D).

    Queries whose distance ratio is above ``max_ratio`` are left out. Keys outside the probed lists
    are not seen, so a nearer one may exist, and a ratio may be too low.
    """
    probed = _probed(queries, lists)  # (M, probes)
    highest = _highest(queries, keys, lists, probed)
    best, column = highest.max(dim=1)
    # The second nearest is in another list or in the same.
    highest.scatter_(1, column[:, None], -1.0)
    of_others = highest.amax(dim=1)
    # The true ratio is at least this one, so only these queries need to know more than the maximum.
    chosen = (distance_ratio(best, of_others) <= max_ratio).nonzero()[:, 0]
    in_list = probed[chosen].gather(1, column[chosen, None])[:, 0]
    index, similarity, second = _two_highest(queries[chosen], keys, lists, in_list)
    ratio = distance_ratio(similarity, torch.maximum(second, of_others[chosen]))
    kept = ratio <= max_ratio
    return Nearest(chosen[kept], index[kept], similarity[kept], ratio[kept])


def distance_ratio(best: Tensor, second: Tensor) -> Tensor:
    """Return the nearest over the second nearest distance of unit vectors, from their cosines."""
    # Distances of unit vectors are sqrt(2 - 2 s); the ratio of two neighbours at distance 0 is 1.
    nearest = (1 - best).clamp(min=1e-12)
    next_nearest = (1 - second).clamp(min=1e-12)
    return (nearest / next_nearest).sqrt()


def _probed(queries: Tensor, lists: Lists) -> Tensor:
    """Return the lists (M, probes) with the nearest centroids of each query."""
    probes = min(PROBES, len(lists.centroids))
    return (queries @ lists.centroids.T).topk(probes, dim=1, sorted=False).indices


def _highest(queries: Tensor, keys: Tensor, lists: Lists, probed: Tensor) -> Tensor:
    """Return the highest similarity (M, probes) of each query in each of its probed lists."""
    order, counts = _by_list(probed.flatten(), lists)
    query = order.div(probed.shape[1], rounding_mode="floor")
    sizes = lists.sizes.tolist()
    # One buffer for all lists: new memory for each takes longer than its product.
    area = max(map(int.__mul__, counts, sizes))
    buffer = queries.new_empty(area)
    found = queries.new_empty(len(order))
    parts = zip(
        torch.split(found, counts),
        torch.split(query, counts),
        torch.split(keys, sizes),
        strict=True,
    )
    for maxima, rows, members in parts:
        shape = (len(members), len(rows))
        similarity = buffer[: shape[0] * shape[1]].view(shape)
        torch.mm(members, queries.index_select(0, rows).T, out=similarity)
        torch.amax(similarity, 0, out=maxima)
    highest = torch.empty_like(found)
    highest[order] = found
    return highest.view(probed.shape)


def _two_highest(
    queries: Tensor, keys: Tensor, lists: Lists, in_list: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the index of each query's nearest key in one list (M,), its similarity, and that of
    the second nearest.
    """
    order, counts = _by_list(in_list, lists)
    index = torch.empty_like(order)
    best = queries.new_empty(len(order))
    second = queries.new_empty(len(order))
    sizes = lists.sizes.tolist()
    start = 0
    parts = zip(torch.split(order, counts), torch.split(keys, sizes), strict=True)
    for rows, members in parts:
        if len(rows):
            similarity = queries[rows] @ members.T
            highest, at = similarity.max(dim=1)
            index[rows] = at + start
            best[rows] = highest
            # A list of one has no second: the lowest similarity remains.
            similarity.scatter_(1, at[:, None], -1.0)
            second[rows] = similarity.amax(dim=1)
        start += len(members)
    return index, best, second


def _by_list(numbers: Tensor, lists: Lists) -> tuple[Tensor, list[int]]:
    """Return the stable order (K,) that sorts numbers of lists, and the count of each list."""
    counts: list[int] = torch.bincount(numbers, minlength=len(lists.sizes)).tolist()
    # Small integers are sorted several times faster.
    return numbers.to(torch.int16).argsort(stable=True), counts
