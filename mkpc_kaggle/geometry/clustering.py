"""DBSCAN in the plane: scikit-learn's labels, without quadratic time and memory where points are clumped.

The clusters are those of Ester, Kriegel, Sander and Xu (1996), the grid is Gunawan's (2013). In a cell of side
eps / sqrt(2) all points are within eps of one another. So every point of a cell with `min_samples` points is core,
and only other points have their neighbours looked up. The core points of a cell are in one cluster: clusters are
connected components of cells: two are joined if a core point of one is within eps of a core point of the other.

"Within eps" is `dx * dx + dy * dy <= eps * eps` in float64, as in scikit-learn's k-d tree. SciPy's tree proposes
neighbours a little farther than eps, and :func:`_within` decides.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Owned = tuple[Floats, Indices]  # points (Q, 2), and the place (Q,), ascending, in a list of cells that each is for

NOISE = -1
MAX_EXTENT = 2**30  # in eps: a cell's number has 62 bits, and what is computed in eps is exact to 1e-6
MARGIN = 1 + 1e-6  # against rounding
DIRECTIONS = np.array([(1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, -1.0)])  # of the extreme points of a cell


def dbscan(points: NDArray[np.float64 | np.float32], *, eps: float, min_samples: int) -> Indices:
    """Cluster labels (N,) of `points` (N, 2), equal to those of `sklearn.cluster.DBSCAN`.

    A point is core when at least `min_samples` points, itself counted, are within `eps` (inclusive). Clusters are
    numbered from 0 in the order of their first core points. A point that is not core takes the lowest number among
    the clusters with a core point within `eps` of it, -1 (noise) where there is none. Memory is that of N *
    `min_samples` numbers. Raises ValueError for points that are not (N, 2), not finite or 2**30 `eps` apart, and
    unless `eps` and `min_samples` are positive.
    """
    xy = np.asarray(points, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"points must have shape (N, 2), not {xy.shape}")
    if not 0 < eps < np.inf or min_samples < 1:
        raise ValueError(f"eps and min_samples must be positive, not {eps} and {min_samples}")
    labels = np.full(len(xy), NOISE, dtype=np.intp)
    if len(xy) == 0:
        return labels
    with np.errstate(over="ignore", invalid="ignore"):
        from_corner = (xy - xy.min(axis=0)) / eps
    if not from_corner.max() < MAX_EXTENT:
        raise ValueError(f"points must be finite and less than {MAX_EXTENT} eps apart")

    column, row = np.floor(from_corner * (np.sqrt(2) * MARGIN)).astype(np.int64).T
    _, cell, size = np.unique(column * 2 * MAX_EXTENT + row, return_inverse=True, return_counts=True)
    core = size[cell] >= min_samples
    rest = np.flatnonzero(~core)
    near = _nearest(xy, xy[rest], min_samples, eps)
    near[~_within(xy[rest][:, None] - xy[near], eps)] = -1
    is_core = (near >= 0).all(axis=1)
    core[rest] = is_core
    if not core.any():
        return labels

    by_cell = np.flatnonzero(core)[np.argsort(cell[core], kind="stable")]
    first = np.diff(cell[by_cell], prepend=-1) > 0
    cells = _Cells(xy[by_cell], np.cumsum(first) - 1, np.flatnonzero(first))
    labels[by_cell] = _components(cells, np.column_stack([column, row])[by_cell[first]], eps)[cells.owner]
    _, first_core, component = np.unique(labels[core], return_index=True, return_inverse=True)
    labels[core] = np.argsort(np.argsort(first_core))[component]
    # A point that is not core has fewer than min_samples neighbours, so all of them are in `near`.
    near = near[~is_core]
    lowest = np.where((near >= 0) & core[near], labels[near], len(xy)).min(axis=1)
    labels[rest[~is_core]] = np.where(lowest < len(xy), lowest, NOISE)
    return labels


@dataclass(frozen=True, slots=True)
class _Cells:
    """Points (P, 2) in the order of their cells, the cell `owner` (P,) of each, the `start` of each of M cells."""

    xy: Floats
    owner: Indices
    start: Indices

    def points_of(self, cells: Indices) -> Owned:
        """The points of each of `cells`, which may repeat."""
        size = np.diff(self.start, append=len(self.xy))[cells]
        place = np.repeat(np.arange(len(cells)), size)
        return self.xy[np.arange(len(place)) + np.repeat(self.start[cells] - np.cumsum(size) + size, size)], place

    def extremes(self, direction: Floats) -> Floats:
        """(M, 2): the point of each cell that is farthest in a direction."""
        along = (self.xy - self.xy[0]) @ direction
        farthest = np.flatnonzero(along == np.maximum.reduceat(along, self.start)[self.owner])
        points = np.empty((len(self.start), 2))
        points[self.owner[farthest]] = self.xy[farthest]
        return points


def _within(offsets: Floats, eps: float) -> Mask:
    """Which offsets (..., 2) are no longer than eps."""
    dx, dy = offsets[..., 0], offsets[..., 1]
    return np.asarray(dx * dx + dy * dy <= eps * eps)


def _nearest(points: Floats, asked: Floats, most: int, eps: float) -> Indices:
    """(Q, most) indices of the points (P, D) nearest to each of (Q, D), hardly farther than eps; -1 for none."""
    if not len(points) or not len(asked):
        return np.full((len(asked), most), -1)
    tree = KDTree(points, balanced_tree=False, compact_nodes=False)
    _, near = tree.query(asked, k=np.arange(1, most + 1), distance_upper_bound=eps * MARGIN)
    return np.where(near < len(points), near, -1)


def _components(cells: _Cells, places: NDArray[np.int64], eps: float) -> Indices:
    """Connected component (M,) of each cell; `places` (M, 2) are their columns and rows in the grid."""
    # Points within eps of each other are in cells at most two columns and two rows apart.
    a, b = KDTree(places).query_pairs(2.9, output_type="ndarray").astype(np.intp).T
    joined, apart = np.zeros((2, len(a)), dtype=bool)
    for direction in DIRECTIONS:  # this joins nearly all cells that belong together
        low, high = cells.extremes(-direction), cells.extremes(direction)
        for offset in (low[a] - high[b], low[b] - high[a]):
            joined |= _within(offset, eps)
            apart |= offset @ direction > eps * np.hypot(*direction) * MARGIN  # a separating axis
    component = _connected(len(places), a[joined], b[joined])
    undecided = np.flatnonzero(~apart & (component[a] != component[b]))
    joined[undecided] = _touching(cells, a[undecided], b[undecided], eps)
    return _connected(len(places), a[joined], b[joined])


def _connected(count: int, a: Indices, b: Indices) -> Indices:
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def _touching(cells: _Cells, a: Indices, b: Indices, eps: float) -> Mask:
    """Which of R pairs of cells have a point of `a` within eps of a point of `b`."""
    touching = np.zeros(len(a), dtype=bool)
    p, q = cells.points_of(a), cells.points_of(b)
    p = _facing(p, q, len(a), eps)
    q = _facing(q, p, len(a), eps)
    # One tree for all pairs: the pair's number, times more than eps, is a third coordinate.
    there, asked = (np.column_stack([xy, 4 * eps * pair]) for xy, pair in (q, p))
    near = _nearest(there, asked, 1, eps)[:, 0]
    found = np.flatnonzero(near >= 0)
    touching[p[1][found[_within(p[0][found] - q[0][near[found]], eps)]]] = True
    return touching


def _facing(p: Owned, q: Owned, count: int, eps: float) -> Owned:
    """The points of `p` within eps of the box around the points of `q` of the same of `count` pairs."""
    (xy, pair), (there, pairs) = p, q
    low, high = np.full((2, count, 2), np.inf)  # nothing is near a pair without points
    start = np.flatnonzero(np.diff(pairs, prepend=-1))
    if len(start):
        low[pairs[start]] = np.minimum.reduceat(there, start)
        high[pairs[start]] = np.maximum.reduceat(there, start)
    facing = _within(np.maximum(np.maximum(low[pair] - xy, xy - high[pair]), 0), eps)
    return xy[facing], pair[facing]
