"""The critical region of an image: Matching Key-Points Crop and Crop Area Expansion.

For each image separately: normalise the matched points of stage 1 by width and height, cluster
them by DBSCAN, and keep the large clusters. The bounding box of the kept points, scaled about its
centre, is the critical region (the paper's Algorithm 1). If this box is unreliable, the region is
the whole image, with the reason.

So ``eps``, 0.05 in all shipped recipes, is a share: of the width along x, and of the height along y. Above 2,000
points, points in one cell of a tenth of ``eps`` are merged first, weighted by their number.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import AT_LEAST_1, POSITIVE, SHARE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Box, Points, Size

# Points. DBSCAN stores each point's neighbours, so dense points take quadratic memory.
MERGE_ABOVE = 2000
CELLS_PER_EPS = 10  # a merged point moves by less than a tenth of the radius on each axis


class When(StrEnum):
    """The pairs that stage 2 runs on."""

    ALWAYS = "always"  # all of them, as in the paper
    SCALE = "scale"  # pairs of different scales, and pairs whose detail a crop restores


@dataclass(frozen=True)
class MkpcConfig:
    """Settings of :func:`critical_region`, and of :func:`mkpc_kaggle.geometry.crop_need.crop_need`.

    Table ``[mkpc]`` of a recipe.

    Parameters
    ----------
    eps : float
        Radius of DBSCAN, relative to the image's width and height.
    min_samples : int
        Points within the radius that make a core point.
    share : float
        Minimum size of a kept cluster, relative to the largest: T of the paper's Algorithm 1.
    expand_x, expand_y : float
        Factors of Crop Area Expansion: the paper's e_h and e_v.
    min_clustered : float
        Minimum share of the points that are in clusters; below it, the region is the whole image.
    min_side : int
        Minimum side of a crop, in pixels; below it, the region is the whole image.
    when : When
        The pairs that stage 2 runs on.
    min_scale : float
        With ``when = "scale"``: minimum ratio of the scales of both images, by their matches.
    min_detail : float
        With ``when = "scale"``: minimum ratio of the scales of a crop's view and the largest view
        of stage 1. Either ratio is enough.

    Raises
    ------
    ValueError
        If a value is outside its range.

    Examples
    --------
    >>> from mkpc_kaggle import MkpcConfig
    >>> MkpcConfig(expand_x=1.2).expand_x
    1.2
    """

    eps: float = 0.05
    min_samples: int = 5
    share: float = 0.05
    expand_x: float = 1.05
    expand_y: float = 1.0
    min_clustered: float = 0.2
    min_side: int = 32
    when: When = When.ALWAYS
    min_scale: float = 1.9
    min_detail: float = 2.0

    def __post_init__(self) -> None:
        check_ranges(
            self, eps=Range(1e-6), min_samples=Range(1, 100), share=SHARE, min_clustered=SHARE
        )
        check_ranges(self, expand_x=POSITIVE, expand_y=POSITIVE, min_side=AT_LEAST_1)
        check_ranges(self, min_scale=AT_LEAST_1, min_detail=AT_LEAST_1)


class RegionReason(StrEnum):
    """Origin of a region: ``CROPPED``, or why it is the whole image."""

    CROPPED = "cropped"
    TOO_FEW_POINTS = "too few points"
    NO_CLUSTER = "no cluster"
    TOO_SCATTERED = "too few points in clusters"
    TOO_SMALL = "box too small"


@dataclass(frozen=True)
class CriticalRegion:
    """The part of an image that stage 2 matches: a box in image pixels, and its reason."""

    box: Box
    reason: RegionReason


def regions_json(regions: Iterable[CriticalRegion]) -> str:
    """Return regions as text, which :func:`regions_of` reads."""
    rows = []
    for region in regions:
        box = region.box
        rows.append((box.left, box.top, box.right, box.bottom, region.reason))
    return json.dumps(rows)


def regions_of(text: str) -> tuple[CriticalRegion, CriticalRegion] | None:
    if not text:
        return None
    first, second = (
        CriticalRegion(Box(*box), RegionReason(reason)) for *box, reason in json.loads(text)
    )
    return first, second


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of an image's N matched points."""

    labels: NDArray[np.intp]  # (N,) the cluster of each point, -1 for noise
    sizes: NDArray[np.intp]  # (K,) the number of points in each cluster
    kept: NDArray[np.intp]  # labels of the clusters in the critical region, largest first

    @property
    def in_kept(self) -> NDArray[np.bool_]:
        """(N,) mask of the points in kept clusters."""
        return np.isin(self.labels, self.kept)


def critical_region(points: Points, size: Size, config: MkpcConfig) -> CriticalRegion:
    """Return the critical region of an image, by its matched points of stage 1.

    Parameters
    ----------
    points : array (N, 2) of float32
        Matched points, in pixels of the image. Points that are not finite or not on the image are
        ignored.
    size : Size
        Width and height of the image, in pixels.
    config : MkpcConfig
        Settings of the clustering and of the expansion.

    Returns
    -------
    CriticalRegion
        The box, and its reason: ``CROPPED``, or why the box is the whole image.

    Examples
    --------
    A dense cluster of 100 points, and a single wrong match far from it:

    >>> import numpy as np
    >>> from mkpc_kaggle import MkpcConfig, Size, critical_region
    >>> x, y = np.meshgrid(np.arange(200, 300, 10), np.arange(100, 200, 10))
    >>> points = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    >>> points = np.append(points, np.float32([[620, 440]]), axis=0)
    >>> region = critical_region(points, Size(640, 480), MkpcConfig())
    >>> region.box
    Box(left=197, top=100, right=294, bottom=191)
    >>> str(region.reason)
    'cropped'
    """
    whole = Box.whole(size)
    points = points[whole.contains(points)]
    # DBSCAN could find no cluster.
    if len(points) < config.min_samples:
        return CriticalRegion(whole, RegionReason.TOO_FEW_POINTS)
    clusters = find_clusters(points, size, config)
    if not len(clusters.sizes):
        return CriticalRegion(whole, RegionReason.NO_CLUSTER)
    if clusters.sizes.sum() / len(points) < config.min_clustered:
        return CriticalRegion(whole, RegionReason.TOO_SCATTERED)
    box = expand_box(points[clusters.in_kept], size, config.expand_x, config.expand_y)
    if min(box.size) < config.min_side:
        return CriticalRegion(whole, RegionReason.TOO_SMALL)
    return CriticalRegion(box, RegionReason.CROPPED)


def find_clusters(points: Points, size: Size, config: MkpcConfig) -> Clusters:
    """Cluster matched points by DBSCAN, and select the clusters to keep.

    Points are (N, 2) float32 in image pixels. DBSCAN's are normalised by the image's width and
    height, so that ``eps`` means the same for every image.
    """
    normalised = np.asarray(points, np.float64) / (size.width, size.height)
    labels = dbscan(normalised, eps=config.eps, min_samples=config.min_samples)
    sizes = np.bincount(labels[labels >= 0])
    return Clusters(labels, sizes, keep_clusters(sizes, config.share))


def dbscan(points: NDArray[np.float64], *, eps: float, min_samples: int) -> NDArray[np.intp]:
    """Return the labels (N,) of scikit-learn's DBSCAN for ``points`` (N, 2), -1 for noise.

    Above ``MERGE_ABOVE`` points, the points in each cell of side eps / 10 become one weighted mean
    point.
    """
    from sklearn.cluster import DBSCAN  # the import takes a second

    if not len(points):
        return np.zeros(0, np.intp)
    cell = np.arange(len(points))  # (N,): the row of each point's merged point
    counts = np.ones(len(points), np.intp)
    if len(points) > MERGE_ABOVE:
        corners = np.floor(points * (CELLS_PER_EPS / eps))
        _, cell, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
        cell = cell.ravel()  # NumPy 2.0.0 returns a column
        mean_x = np.bincount(cell, points[:, 0]) / counts
        mean_y = np.bincount(cell, points[:, 1]) / counts
        points = np.column_stack([mean_x, mean_y])
    # ``min_samples`` counts weights, so a merged point counts as the points that it stands for.
    algorithm = DBSCAN(eps=eps, min_samples=min_samples, algorithm="kd_tree")
    found = algorithm.fit(points, sample_weight=counts)
    return np.asarray(found.labels_[cell], np.intp)


def keep_clusters(sizes: NDArray[np.intp], share: float) -> NDArray[np.intp]:
    """Return the labels of the clusters to keep, largest first.

    ``sizes`` (K,) is the number of points per label. Keeps clusters with at least ``share`` of the
    largest cluster's points. Clusters of equal size keep their order.
    """
    by_size = np.argsort(-sizes, kind="stable")
    # Sizes fall, so this is where Algorithm 1 stops at the first cluster that is too small.
    ratios = sizes[by_size] / sizes.max(initial=1)
    kept: NDArray[np.intp] = by_size[ratios >= share]
    return kept


def expand_box(points: Points, size: Size, expand_x: float, expand_y: float) -> Box:
    """Return the bounding box of ``points``, scaled about its centre and clipped to the image.

    This is Crop Area Expansion. Before scaling, the box spans whole pixels, [min, max + 1), so it
    includes the last row and column. Scaled edges are rounded outwards.
    """
    # The pixel that contains x is floor(x + 0.5), since pixel centres are at integers.
    low = np.floor(points.min(axis=0).astype(np.float64) + 0.5)
    high = np.floor(points.max(axis=0).astype(np.float64) + 0.5) + 1
    centre = (low + high) / 2
    half = (high - low) / 2 * (expand_x, expand_y)
    left, top = np.maximum(np.floor(centre - half), 0).astype(int)
    right, bottom = np.minimum(np.ceil(centre + half), size).astype(int)
    return Box(int(left), int(top), int(right), int(bottom))
