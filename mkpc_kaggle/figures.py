"""Figures, drawn with matplotlib: everything that this package paints is painted here.

Colours are the Okabe-Ito palette, which colour-blind readers can tell apart.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.critical_region import MkpcConfig, cluster_points, keep_clusters
from mkpc_kaggle.images import Image
from mkpc_kaggle.pipeline import PairMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INLIER, OUTLIER, REGION, DROPPED = "#009E73", "#D55E00", "#F0E442", "#999999"
CLUSTERS = ("#56B4E9", "#E69F00", "#CC79A7", "#0072B2", "#009E73", "#D55E00")
MOST_LINES = 150
"""Lines that an eye can follow; a figure with more matches shows an even sample and says so."""


def draw_pair(image0: Image, image1: Image, match: PairMatch, config: MkpcConfig) -> "Figure":
    """Two rows: the matches of all units coloured by inlier; the clusters of stage 1 and the critical regions."""
    figure = new_figure(12, 9)
    rows = figure.subplots(2, 2)
    _draw_matches(rows[0], (image0, image1), match)
    for axes, image, side in zip(rows[1], (image0, image1), (0, 1), strict=True):
        _draw_clusters(axes, image, match, config, side)
    return figure


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of that size in inches; :class:`UserError` without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("figures need matplotlib: pip install 'mkpc-kaggle[plots]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def save(figure: "Figure", path: Path) -> None:
    """Write a figure; the suffix says the format. Raises :class:`UserError` where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise UserError(f"the figure {path} cannot be written: {error}") from error


def _draw_matches(axes: "NDArray[Any]", images: tuple[Image, Image], match: PairMatch) -> None:
    from matplotlib.patches import ConnectionPatch

    matches, inliers = match.matches, match.estimate.inliers
    for one, image in zip(axes, images, strict=True):
        _show(one, image)
    drawn = _sample(~inliers, MOST_LINES // 5), _sample(inliers, MOST_LINES)
    for indices, colour, width in ((drawn[0], OUTLIER, 0.5), (drawn[1], INLIER, 0.7)):
        for one, points in zip(axes, (matches.points0, matches.points1), strict=True):
            one.scatter(*points[indices].T, s=6, c=colour, linewidths=0)
        for index in indices:
            line = ConnectionPatch(
                matches.points0[index],
                matches.points1[index],
                "data",
                "data",
                axesA=axes[0],
                axesB=axes[1],
                color=colour,
                linewidth=width,
                alpha=0.6,
            )
            axes[0].figure.add_artist(line)
    shown = f"{len(drawn[1])} inliers (green) and {len(drawn[0])} outliers (orange) drawn"
    why = f"; {match.estimate.failure}" if match.estimate.failure else ""
    axes[0].set_title(f"{len(matches)} matches, {match.estimate.inlier_count} inliers{why}", loc="left")
    axes[1].set_title(shown, loc="left")


def _draw_clusters(axes: "Axes", image: Image, match: PairMatch, config: MkpcConfig, side: int) -> None:
    _show(axes, image)
    if match.regions is None:
        axes.set_title("no stage 2: no critical region", loc="left")
        return
    region = match.regions[side]
    stage1 = [result.matches for result in match.results if result.unit.stage == 1]
    points = np.concatenate([part.points1 if side else part.points0 for part in stage1])
    labels = cluster_points(points, image.size, config) if len(points) else np.zeros(0, np.intp)
    sizes = np.bincount(labels[labels >= 0])
    kept = keep_clusters(sizes, config.share, config.ratio) if len(sizes) else np.zeros(0, np.intp)
    dropped = ~np.isin(labels, kept)
    axes.scatter(points[dropped, 0], points[dropped, 1], s=8, c=DROPPED, marker="x", linewidths=0.7)
    for rank, label in enumerate(kept):
        x, y = points[labels == label].T
        axes.scatter(x, y, s=8, c=CLUSTERS[rank % len(CLUSTERS)], linewidths=0)
    box = region.box
    left, top = box.left - 0.5, box.top - 0.5
    axes.add_patch(_rectangle(left, top, box.size.width, box.size.height))
    axes.set_title(
        f"critical region: {region.reason}, {100 * box.area / (image.size.width * image.size.height):.0f} % of "
        f"the image\n{region.kept} of {region.clusters} clusters kept; grey crosses: noise and dropped",
        loc="left",
    )


def _rectangle(left: float, top: float, width: float, height: float) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((left, top), width, height, fill=False, edgecolor=REGION, linewidth=2.5)


def _show(axes: "Axes", image: Image) -> None:
    axes.imshow(image.pixels)
    axes.set_xticks([])
    axes.set_yticks([])


def _sample(mask: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """At most ``most`` indices of a mask, evenly spread."""
    indices: NDArray[np.intp] = np.flatnonzero(mask)
    if len(indices) <= most:
        return indices
    chosen: NDArray[np.intp] = indices[np.linspace(0, len(indices) - 1, most).round().astype(int)]
    return chosen
