"""Mutual nearest neighbours of descriptors, in blocks: the N x M matrix is never stored."""

from dataclasses import dataclass

import torch
from torch import Tensor

from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import PairwiseMatcher
from mkpc_kaggle.matchers.sparse import Keypoints, matches_of

BLOCK_ROWS = 2048


@dataclass(frozen=True)
class Neighbours:
    """M mutual pairs: ``index0``, ``index1`` (M,) int64, ``similarity`` (M,) cosine in -1..1, ``ratio`` (M,).

    The ratio is nearest over second nearest distance, the larger one of both directions.
    """

    index0: Tensor
    index1: Tensor
    similarity: Tensor
    ratio: Tensor


class NeighbourMatcher(PairwiseMatcher[Keypoints]):
    """Mutual nearest neighbours whose distance ratio is at most ``ratio``, scored by their cosine."""

    ratio: float

    def _match(self, first: Keypoints, second: Keypoints) -> Matches:
        pairs = mutual_neighbours(first.descriptors, second.descriptors)
        passed = pairs.ratio <= self.ratio
        index0, index1, scores = pairs.index0[passed], pairs.index1[passed], self._scores(pairs)[passed]
        return matches_of(first.points, second.points, index0, index1, scores)

    def _scores(self, pairs: Neighbours) -> Tensor:
        return pairs.similarity


def mutual_neighbours(descriptors0: Tensor, descriptors1: Tensor) -> Neighbours:
    """Pair unit descriptors, (N, D) and (M, D), that are each other's nearest; in order of the first image.

    Of equal neighbours the lower index counts. A missing second neighbour counts as one at the maximum distance.
    """
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        nothing = descriptors0.new_zeros(0)
        return Neighbours(nothing.long(), nothing.long(), nothing, nothing)
    best0, second0, nearest0 = _two_best(descriptors0, descriptors1)
    best1, second1, nearest1 = _two_best(descriptors1, descriptors0)
    index0 = torch.arange(len(descriptors0), device=descriptors0.device)
    index0 = index0[nearest1[nearest0] == index0]
    index1 = nearest0[index0]
    ratio0, ratio1 = _distance_ratio(best0, second0)[index0], _distance_ratio(best1, second1)[index1]
    return Neighbours(index0, index1, best0[index0], torch.maximum(ratio0, ratio1))


def _two_best(queries: Tensor, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return each query's highest and second highest similarity (N,), and the index of the highest (N,)."""
    best, second, nearest = [], [], []
    for start in range(0, len(queries), BLOCK_ROWS):
        similarity = queries[start : start + BLOCK_ROWS] @ keys.T  # (rows, M)
        top, index = similarity.max(dim=1)
        best.append(top)
        nearest.append(index)
        similarity.scatter_(1, index[:, None], -1.0)
        second.append(similarity.amax(dim=1))
    return torch.cat(best), torch.cat(second), torch.cat(nearest)


def _distance_ratio(best: Tensor, second: Tensor) -> Tensor:
    """Return the ratio of distances sqrt(2 - 2 s) of unit vectors; 1 for two neighbours at distance 0."""
    nearest, next_nearest = (1 - best).clamp(min=1e-12), (1 - second).clamp(min=1e-12)
    return (nearest / next_nearest).sqrt()
