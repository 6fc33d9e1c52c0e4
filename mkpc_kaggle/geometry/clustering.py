"""DBSCAN in the plane: scikit-learn's labels, with memory and time that dense clumps do not blow up.

The clusters are those of Ester, Kriegel, Sander and Xu (1996). The grid is Gunawan's (2013): in a cell of side
eps / sqrt(2) all points are within eps of one another, hence a cell of `min_samples` points is all core, and only
points of sparser cells have neighbours to count; the core points of a cell are of one cluster, hence clusters are
the connected components of *cells*, two of which are joined when some core point of one is within eps of some core
point of the other. No list of neighbours is ever kept, so memory is linear in the number of points.

Points are float64 (N, 2) in any unit, eps in the same; indices are intp. "Within eps" is decided everywhere by
`dx * dx + dy * dy <= eps * eps` in float64, as scikit-learn's k-d tree does. Rounding is monotone, so deciding it
for a cell's box in the same arithmetic decides it for every point of the cell.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

NOISE = -1

# A direction and its opposite are four places apart.
_DIRECTIONS = np.array([[1, 0], [0, 1], [1, 1], [1, -1], [-1, 0], [0, -1], [-1, -1], [-1, 1]], dtype=np.float64)
_CELL_SHRINK = 1 - 1e-6  # rounding must not put two points of a cell farther apart than eps
_HEAVY_PAIR = 4096  # point pairs from which two k-d trees are cheaper than brute force
_CHUNK = 1 << 15  # distances computed at a time: they stay in the cache
_BLOCK = 1 << 12  # points whose neighbouring cells are looked up at a time


def dbscan(points: NDArray[np.float64 | np.float32], *, eps: float, min_samples: int) -> Indices:
    """Cluster labels (N,) of `points` (N, 2), equal to those of `sklearn.cluster.DBSCAN`.

    A point is core when at least `min_samples` points, itself counted, are within `eps` (inclusive). Clusters are
    numbered from 0 in the order of their first core points; a point that is not core takes the lowest number among
    the clusters with a core point within `eps` of it, -1 (noise) where there is none.

    Raises ValueError for points that are not (N, 2) or not finite, for `min_samples` < 1, and for an `eps` that is
    not positive or whose square is no normal float64.
    """
    xy = np.asarray(points, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"points must have shape (N, 2), not {xy.shape}")
    if not np.isfinite(xy).all():
        raise ValueError("points must be finite")
    if not (eps > 0 and np.finfo(np.float64).tiny <= float(eps) * float(eps) < np.inf):
        raise ValueError(f"eps must be positive and its square a normal float64, not {eps}")
    if min_samples < 1:
        raise ValueError(f"min_samples must be at least 1, not {min_samples}")
    labels = np.full(len(xy), NOISE, dtype=np.intp)
    if len(xy) == 0:
        return labels

    grid = _grid(xy, float(eps))
    core = _core_points(grid, min_samples)
    if not core.any():
        return labels
    core_cells = grid.subset(core)
    cluster = _numbered(_components(core_cells), core_cells)
    labels[core_cells.index] = np.repeat(cluster, core_cells.size)
    labels[grid.index[~core]] = _border_labels(grid, ~core, core_cells, cluster)
    return labels


@dataclass(frozen=True, slots=True)
class _Cells:
    """P points grouped by grid cell, M cells in ascending order of key; none is empty."""

    eps: float
    stride: int  # key of a cell = its column * stride + its row
    xy: Floats  # (P, 2)
    index: Indices  # (P,) row of each point in the caller's array, ascending within a cell
    keys: Indices  # (M,)
    start: Indices  # (M,) where a cell's points begin
    size: Indices  # (M,) how many they are
    low: Floats  # (M, 2) bounding boxes
    high: Floats  # (M, 2)

    @classmethod
    def group(cls, eps: float, stride: int, xy: Floats, index: Indices, point_keys: Indices) -> "_Cells":
        """Cells of points that come in ascending order of their keys (P,)."""
        start = np.flatnonzero(np.diff(point_keys, prepend=-1))
        size = np.diff(start, append=len(point_keys))
        low, high = np.minimum.reduceat(xy, start), np.maximum.reduceat(xy, start)
        return cls(eps, stride, xy, index, point_keys[start], start, size, low, high)

    def point_keys(self) -> Indices:
        return np.repeat(self.keys, self.size)

    def subset(self, keep: NDArray[np.bool_]) -> "_Cells":
        return _Cells.group(self.eps, self.stride, self.xy[keep], self.index[keep], self.point_keys()[keep])

    def copies(self, cells: Indices) -> "_Cells":
        """The listed cells, which may repeat, with their places in the list as keys."""
        place, point = self.members(cells)
        return _Cells.group(self.eps, self.stride, self.xy[point], self.index[point], place)

    def within(self, offset: Floats) -> NDArray[np.bool_]:
        """Whether offsets (..., 2) are no longer than eps."""
        dx, dy = offset[..., 0], offset[..., 1]
        return dx * dx + dy * dy <= self.eps * self.eps

    def members(self, cells: Indices) -> tuple[Indices, Indices]:
        """All points of the listed cells: place of the cell in the list, and place of the point in `xy`."""
        size = self.size[cells]
        place = np.repeat(np.arange(len(cells)), size)
        shift = self.start[cells] - (np.cumsum(size) - size)
        return place, np.arange(len(place)) + shift[place]

    def around(self, keys: Indices) -> tuple[Indices, Indices]:
        """Pairs (place in `keys`, cell): the cells, 25 at most, that may hold a point within eps of a cell `keys`.

        They are those at most two columns and two rows away; a column's rows follow one another.
        """
        lowest = keys[:, None] + self.stride * np.arange(-2, 3) - 2
        cell = np.searchsorted(self.keys, lowest)[..., None] + np.arange(5)
        beyond = np.append(self.keys, np.full(5, np.iinfo(np.intp).max))
        found = np.flatnonzero(beyond.take(cell) < lowest[..., None] + 5)
        return found // 25, cell.ravel()[found]

    def boxes(self, cell: Indices) -> tuple[Floats, Floats]:
        return self.low.take(cell, axis=0), self.high.take(cell, axis=0)  # several times faster than low[cell]

    def near_box(self, xy: Floats, cell: Indices) -> NDArray[np.bool_]:
        """Whether the box of `cell` (Q,) is within eps of the point `xy` (Q, 2), for each of Q pairs."""
        low, high = self.boxes(cell)
        return self.within(np.maximum(np.maximum(low - xy, xy - high), 0))

    def count_within(self, xy: Floats, cell: Indices) -> Indices:
        """How many points of `cell` (Q,) are within eps of the point `xy` (Q, 2), for each of Q pairs."""
        low, high = self.boxes(cell)
        whole = self.within(np.maximum(xy - low, high - xy))  # the offset of the box's farthest corner
        count = np.where(whole, self.size[cell], 0)
        partial = np.flatnonzero(~whole & self.near_box(xy, cell))
        for part in _chunks(partial, self.size[cell[partial]]):
            pair, point = self.members(cell[part])
            hit = self.within(xy[part].take(pair, axis=0) - self.xy.take(point, axis=0))
            count[part] = np.bincount(pair[hit], minlength=len(part))
        return count


def _chunks(rows: Indices, cost: Indices) -> Iterator[Indices]:
    """Consecutive parts of `rows`, each of a total cost of about `_CHUNK`."""
    chunk = np.cumsum(cost) // _CHUNK
    yield from np.split(rows, np.flatnonzero(np.diff(chunk)) + 1)


def _grid(xy: Floats, eps: float) -> _Cells:
    column, row = _strips(xy[:, 0], eps), _strips(xy[:, 1], eps)
    stride = int(row.max()) + 5  # two rows past either end are still no row of another column
    keys = column * stride + row
    order = np.argsort(keys, kind="stable")
    return _Cells.group(eps, stride, xy[order], order, keys[order])


def _strips(x: Floats, eps: float) -> Indices:
    """Numbers (N,) of the strips, a little narrower than eps / sqrt(2), that coordinates (N,) lie in.

    Coordinates within eps of each other are at most two strips apart. A gap above eps begins a new run of strips,
    three further on: the numbers stay below 5 N and precise however far apart, or far from 0, the points are.
    """
    order = np.argsort(x)
    ascending = x[order]
    with np.errstate(over="ignore"):  # an infinite gap is a gap
        first = np.append(True, np.diff(ascending) ** 2 > eps * eps)
    run = np.cumsum(first) - 1
    strip = np.floor((ascending - ascending[first][run]) / (eps / np.sqrt(2) * _CELL_SHRINK)).astype(np.intp)
    width = strip[np.append(first[1:], True)] + 3
    numbers = np.empty(len(x), dtype=np.intp)
    numbers[order] = strip + (np.cumsum(width) - width)[run]
    return numbers


def _core_points(grid: _Cells, min_samples: int) -> NDArray[np.bool_]:
    """Which points (P,) are core. Only fewer than `min_samples` points of a cell have their neighbours counted."""
    core = np.repeat(grid.size >= min_samples, grid.size)
    sparse = np.flatnonzero(~core)
    count = np.zeros(len(sparse), dtype=np.intp)
    for place, _, found in _neighbours(grid, sparse, grid):
        np.add.at(count, place, found)
    core[sparse] = count >= min_samples
    return core


def _neighbours(grid: _Cells, points: Indices, cells: _Cells) -> Iterator[tuple[Indices, Indices, Indices]]:
    """Blocks of (place in `points`, cell, its points within eps: at least one): memory stays linear."""
    keys = grid.point_keys()[points]
    for begin in range(0, len(points), _BLOCK):
        block = points[begin : begin + _BLOCK]
        place, cell = cells.around(keys[begin : begin + _BLOCK])
        found = cells.count_within(grid.xy.take(block[place], axis=0), cell)
        reached = found > 0
        yield begin + place[reached], cell[reached], found[reached]


def _components(cells: _Cells) -> Indices:
    """Connected component (M,) of each cell of core points.

    A few representatives join nearly all cells that belong together; what is left is decided exactly.
    """
    a, b = cells.around(cells.keys)
    a, b = a[a < b], b[a < b]
    support, extent = _supports(cells)
    opposing, behind = np.roll(support, 4, axis=1), np.roll(extent, 4, axis=1)

    # Separating axis: no two points are within eps where the gap along some direction is longer than that.
    reach = cells.eps * np.hypot(*_DIRECTIONS.T) + 2.0**-48 * np.abs(cells.xy).max()
    with np.errstate(over="ignore", invalid="ignore"):  # coordinates near the end of float64: no axis separates
        apart = (-extent.take(a, axis=0) - behind.take(b, axis=0) > reach).any(axis=1)
    a, b = a[~apart], b[~apart]

    between = cells.xy.take(support[a], axis=0) - cells.xy.take(opposing[b], axis=0)
    joined = np.any(cells.within(between), axis=1)
    component = _connected(len(cells.keys), a[joined], b[joined])
    undecided = np.flatnonzero(component[a] != component[b])
    joined[undecided] = _touching(cells, a[undecided], b[undecided])
    return _connected(len(cells.keys), a[joined], b[joined])


def _connected(count: int, a: Indices, b: Indices) -> Indices:
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def _supports(cells: _Cells) -> tuple[Indices, Floats]:
    """A farthest point of each cell in each of the eight directions, and how far it is: both (M, 8)."""
    shape = (len(cells.keys), len(_DIRECTIONS))
    support, extent = np.empty(shape, dtype=np.intp), np.empty(shape)
    cell = np.repeat(np.arange(len(cells.keys)), cells.size)
    for k, (ux, uy) in enumerate(_DIRECTIONS):
        with np.errstate(over="ignore"):
            along = ux * cells.xy[:, 0] + uy * cells.xy[:, 1]
        extent[:, k] = np.maximum.reduceat(along, cells.start)
        farthest = np.flatnonzero(along == extent[cell, k])
        support[cell[farthest], k] = farthest
    return support, extent


def _touching(cells: _Cells, a: Indices, b: Indices) -> NDArray[np.bool_]:
    """Whether some point of cell `a` is within eps of some point of cell `b`, for each of R pairs of cells."""
    p, q = cells.copies(a), cells.copies(b)  # their keys are the pairs' places
    p, q = _facing(p, q)
    q, p = _facing(q, p)
    p, q = _facing(p, q)  # again, since q's box has shrunk
    decided = np.zeros(len(p.keys), dtype=np.bool_)
    touching = np.zeros(len(a), dtype=np.bool_)
    for r in np.flatnonzero(p.size * q.size >= _HEAVY_PAIR):
        trees = [KDTree(c.xy[c.start[r] :][: c.size[r]], balanced_tree=False) for c in (p, q)]
        # KDTree rounds differently from `within`: its answer is used only where rounding does not matter.
        surely, possibly = np.asarray(trees[0].count_neighbors(trees[1], p.eps * np.array([1 - 1e-9, 1 + 1e-9])))
        touching[p.keys[r]] = surely > 0
        decided[r] = surely > 0 or possibly == 0

    rest = np.flatnonzero(~decided)
    for part in _chunks(rest, p.size[rest]):
        pair, point = p.members(part)
        found = q.count_within(p.xy.take(point, axis=0), part[pair])
        touching[p.keys[part[pair[found > 0]]]] = True
    return touching


def _facing(p: _Cells, q: _Cells) -> tuple[_Cells, _Cells]:
    """The points of p that are within eps of the box of q's cell of the same key, and q of the keys then left."""
    cell = np.repeat(np.arange(len(p.keys)), p.size)
    p = p.subset(q.near_box(p.xy, cell))
    return p, q.subset(np.isin(q.point_keys(), p.keys))


def _numbered(component: Indices, cells: _Cells) -> Indices:
    """Cluster number (M,) of each cell: components in the order of their lowest point index."""
    first = np.full(int(component.max()) + 1, np.iinfo(np.intp).max)
    np.minimum.at(first, component, cells.index[cells.start])
    rank = np.empty_like(first)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[component]


def _border_labels(grid: _Cells, rest: NDArray[np.bool_], core_cells: _Cells, cluster: Indices) -> Indices:
    """Labels of the points that are not core: the lowest cluster with a core point within eps, or noise."""
    points = np.flatnonzero(rest)
    beyond = len(cluster)
    label = np.full(len(points), beyond, dtype=np.intp)
    for place, cell, _ in _neighbours(grid, points, core_cells):
        np.minimum.at(label, place, cluster[cell])
    return np.where(label == beyond, NOISE, label)
