"""Mutual nearest neighbours of descriptors, in blocks of the N x M matrix."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture
from mkpc_kaggle.matchers.networks.layers import Assignment
from mkpc_kaggle.matchers.sparse import Encode, Keypoints, matches_of

# On a CPU, a block of 512 x 8,000 similarities fits the cache. A GPU is idle between small blocks.
BLOCK_ROWS = {"cpu": 512, "cuda": 8192}
GROUP = 64  # keys


@dataclass(frozen=True)
class Neighbours:
    """M mutual pairs: ``index0`` and ``index1`` (M,) int64, ``similarity`` and ``ratio`` (M,).

    A similarity is a cosine in -1..1. A ratio is the nearest over the second nearest distance, the
    larger one of the two directions.
    """

    index0: Tensor
    index1: Tensor
    similarity: Tensor
    ratio: Tensor


class NeighbourMatcher(PairwiseMatcher[Keypoints]):
    """Mutual nearest neighbours with a distance ratio up to ``ratio``, scored by their cosine."""

    def __init__(self, spec: MatcherSpec, encode: Encode, ratio: float) -> None:
        self.spec = spec
        self.ratio = ratio
        self._encode = encode

    def encode(self, pictures: Sequence[Picture]) -> list[Keypoints]:
        return self._encode(pictures)

    def _match(self, first: Keypoints, second: Keypoints) -> Matches:
        pairs = mutual_neighbours(first.descriptors, second.descriptors, self.ratio)
        found = Assignment(pairs.index0, pairs.index1, self._scores(pairs))
        return matches_of(first.points, second.points, found)

    def _scores(self, pairs: Neighbours) -> Tensor:
        return pairs.similarity


def mutual_neighbours(
    descriptors0: Tensor, descriptors1: Tensor, max_ratio: float = 1.0
) -> Neighbours:
    """Pair unit descriptors (N, D) and (M, D) that are each other's nearest.

    Pairs are in the order of the first image. Ties go to the lower index. A missing second
    neighbour counts as one at the maximum distance. Pairs with a ratio above ``max_ratio`` are
    dropped.
    """
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        nothing = descriptors0.new_zeros(0)
        return Neighbours(nothing.long(), nothing.long(), nothing, nothing)
    similarity, ratio0, nearest0 = _nearest(descriptors0, descriptors1)
    # Few pass a low ratio; only these need the other direction.
    index0 = (ratio0 <= max_ratio).nonzero()[:, 0]
    index1 = nearest0[index0]
    _, ratio1, nearest1 = _nearest(descriptors1[index1], descriptors0)
    ratio = torch.maximum(ratio0[index0], ratio1)
    kept = (nearest1 == index0) & (ratio <= max_ratio)
    return Neighbours(index0[kept], index1[kept], similarity[index0[kept]], ratio[kept])


def _nearest(queries: Tensor, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the similarity, distance ratio and index of each query's nearest key, all (N,)."""
    # Zeros complete the last group; below they get the lowest similarity.
    rest = -len(keys) % GROUP
    filled = torch.cat([keys, keys.new_zeros(rest, keys.shape[1])])
    # One buffer for all blocks: new memory for each block takes a third of the product's time.
    rows = BLOCK_ROWS.get(queries.device.type, 512)
    buffer = queries.new_empty(min(rows, len(queries)), len(filled))
    similarities = []
    ratios = []
    indices = []
    for block in torch.split(queries, rows):
        similarity = torch.mm(block, filled.T, out=buffer[: len(block)])  # (rows, M)
        similarity[:, len(keys) :] = -1.0
        # Only the maximum of each group is taken over all keys: a search for its index is slow.
        groups = similarity.view(len(block), len(filled) // GROUP, GROUP)
        highest = groups.amax(dim=2)  # (rows, groups)
        best, group = highest.max(dim=1)
        # (rows, GROUP)
        inside = groups.gather(1, group[:, None, None].expand(-1, 1, GROUP))[:, 0]
        offset = inside.argmax(dim=1)
        # The second nearest is in the same group or has the maximum of another group.
        inside.scatter_(1, offset[:, None], -1.0)
        highest.scatter_(1, group[:, None], -1.0)
        second = torch.maximum(inside.amax(dim=1), highest.amax(dim=1))
        similarities.append(best)
        # Distances of unit vectors are sqrt(2 - 2 s); the ratio of two neighbours at distance 0 is 1.
        nearest = (1 - best).clamp(min=1e-12)
        next_nearest = (1 - second).clamp(min=1e-12)
        ratios.append((nearest / next_nearest).sqrt())
        indices.append(group * GROUP + offset)
    return torch.cat(similarities), torch.cat(ratios), torch.cat(indices)
