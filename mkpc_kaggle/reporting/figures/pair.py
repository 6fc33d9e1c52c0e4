"""One pair at a glance: its matches, its clusters, its critical regions."""

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.critical_region import MkpcConfig, find_clusters
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.reporting.figures.canvas import (
    CLUSTERS,
    DROPPED,
    INLIER,
    MOST_LINES,
    OUTLIER,
    add_box,
    add_rectangle,
    new_figure,
    sample,
    show,
)

STRIP_HEIGHT, STRIP_PIXELS = 480, 2_000_000

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_pair(image0: Image, image1: Image, match: PairMatch, config: MkpcConfig) -> "Figure":
    """Two rows: the matches of all units coloured by inlier; the clusters of stage 1 and the critical regions."""
    figure = new_figure(12, 9)
    rows = figure.subplots(2, 2)
    _draw_matches(rows[0], (image0, image1), match)
    for axes, image, side in zip(rows[1], (image0, image1), (0, 1), strict=True):
        _draw_clusters(axes, image, match, config, side)
    return figure


def draw_strip(images: tuple[Image, Image], match: PairMatch) -> "Figure":
    """The two images side by side at one height: lines are matches, boxes the critical regions; no text.

    The strip has at most :data:`STRIP_PIXELS`.
    """
    aspect = sum(image.size.width / image.size.height for image in images)
    height = max(1, min(STRIP_HEIGHT, int(sqrt(STRIP_PIXELS / aspect))))
    scales = [height / image.size.height for image in images]
    widths = [max(1, round(image.size.width * scale)) for image, scale in zip(images, scales, strict=True)]
    shown = [
        cv2.resize(i.pixels, (w, height), interpolation=cv2.INTER_AREA)
        for i, w in zip(images, widths, strict=True)
    ]
    figure = new_figure(sum(widths) / 110, height / 110)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(np.hstack(shown))
    axes.axis("off")
    _draw_lines(axes, match, scales, widths[0])
    for side, region in enumerate(match.regions or ()):
        box, scale, shift = region.box, scales[side], side * widths[0]
        corner = box.left * scale + shift - 0.5, box.top * scale - 0.5
        add_rectangle(axes, corner, box.size.width * scale, box.size.height * scale)
    return figure


def _draw_lines(axes: "Axes", match: PairMatch, scales: Sequence[float], shift: float) -> None:
    from matplotlib.collections import LineCollection

    matches, inliers = match.matches, match.estimate.inliers
    ends0 = (matches.points0 + 0.5) * scales[0] - 0.5
    ends1 = (matches.points1 + 0.5) * scales[1] - 0.5 + (shift, 0)
    lines = np.stack([ends0, ends1], axis=1)
    for mask, most, colour, width in (
        (~inliers, MOST_LINES // 3, OUTLIER, 0.6),
        (inliers, MOST_LINES, INLIER, 1.0),
    ):
        drawn = lines[sample(mask, most)]
        axes.add_collection(LineCollection(list(drawn), colors=colour, linewidths=width, alpha=0.75))
        x, y = drawn.reshape(-1, 2).T
        axes.scatter(x, y, s=5, color=colour, linewidths=0)


def _draw_matches(axes: "Sequence[Axes]", images: tuple[Image, Image], match: PairMatch) -> None:
    for one, image in zip(axes, images, strict=True):
        show(one, image)
    drawn = connect(axes, match.matches, match.estimate.inliers)
    why = f"; {match.estimate.failure}" if match.estimate.failure else ""
    axes[0].set_title(f"{len(match.matches)} matches, {match.estimate.inlier_count} inliers{why}", loc="left")
    axes[1].set_title(drawn, loc="left")


def connect(axes: "Sequence[Axes]", matches: Matches, inliers: NDArray[np.bool_]) -> str:
    """Draw matches from one picture to the other, a sample of them where there are many; what was drawn."""
    from matplotlib.patches import ConnectionPatch

    drawn = sample(~inliers, MOST_LINES // 5), sample(inliers, MOST_LINES)
    for indices, colour, width in ((drawn[0], OUTLIER, 0.5), (drawn[1], INLIER, 0.7)):
        for one, points in zip(axes, (matches.points0, matches.points1), strict=True):
            one.scatter(points[indices, 0], points[indices, 1], s=6, c=colour, linewidths=0)
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
    return f"{len(drawn[1])} inliers (green) and {len(drawn[0])} outliers (orange) drawn"


def _draw_clusters(axes: "Axes", image: Image, match: PairMatch, config: MkpcConfig, side: int) -> None:
    show(axes, image)
    if match.regions is None:
        axes.set_title("no stage 2: no critical region", loc="left")
        return
    region = match.regions[side]
    stage1 = match.matches[match.in_stage(1)]
    points = stage1.points1 if side else stage1.points0
    clusters = find_clusters(points, image.size, config)
    dropped = ~clusters.in_kept
    axes.scatter(points[dropped, 0], points[dropped, 1], s=8, c=DROPPED, marker="x", linewidths=0.7)
    for rank, label in enumerate(clusters.kept):
        x, y = points[clusters.labels == label].T
        axes.scatter(x, y, s=8, c=CLUSTERS[rank % len(CLUSTERS)], linewidths=0)
    box = region.box
    add_box(axes, box)
    axes.set_title(
        f"critical region: {region.reason}, {100 * box.area / (image.size.width * image.size.height):.0f} % of "
        f"the image\n{region.kept} of {region.clusters} clusters kept; grey crosses: noise and dropped",
        loc="left",
    )
