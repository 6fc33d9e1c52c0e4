"""One pair: its matches, the clusters of stage 1, and the critical regions."""

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Box, View
from mkpc_kaggle.geometry.critical_region import CriticalRegion, MkpcConfig, find_clusters
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.reporting.figures import style
from mkpc_kaggle.reporting.figures.style import COLOURS, DROPPED, INLIER, OUTLIER, new_figure, sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIP_HEIGHT_PX, MAX_STRIP_PX = 480, 2_000_000
MAX_INLIERS, MAX_OUTLIERS = 150, 50  # number of lines that stay legible


def draw_pair(image0: Image, image1: Image, match: PairMatch, config: MkpcConfig) -> "Figure":
    """Draw the matches of all units and the critical regions at the top, the clusters of stage 1 below."""
    figure = new_figure(12, 9)
    panels = figure.subplot_mosaic([["matches", "matches"], ["0", "1"]])
    counts = f"{len(match.matches)} matches, {match.estimate.inlier_count} inliers"
    drawn = draw_matches(panels["matches"], (image0, image1), match)
    title = "; ".join(filter(None, [counts, match.estimate.failure, drawn]))
    panels["matches"].set_title(title, loc="left")
    for side, image in enumerate((image0, image1)):
        _draw_clusters(panels[str(side)], image, match, config, side)
    return figure


def draw_strip(images: tuple[Image, Image], match: PairMatch) -> "Figure":
    """Draw the matches and the critical regions without text, on up to :data:`MAX_STRIP_PX` pixels."""
    aspect = sum(view.content.width / view.content.height for view in map(_upright, images))
    height = min(STRIP_HEIGHT_PX, sqrt(MAX_STRIP_PX / aspect)) / style.DPI
    figure = new_figure(aspect * height, height)
    figure.set_layout_engine("none")
    draw_matches(figure.add_axes((0, 0, 1, 1)), images, match)
    return figure


def draw_matches(axes: "Axes", images: tuple[Image, Image], match: PairMatch) -> str:
    """Show the images side by side, matches as lines, critical regions as boxes. Return the drawn objects.

    Where there are many matches, an even sample is drawn. The axes' unit is the height of both images.
    """
    from matplotlib.collections import LineCollection

    ends: list[NDArray[np.float64]] = []
    left = 0.0
    for side, points in enumerate((match.matches.points0, match.matches.points1)):
        view = _upright(images[side])
        width, height = view.content
        _show(axes, images[side], match.regions and match.regions[side], 1 / height, left)
        ends.append((view.from_image(points) + 0.5) / height + (left, 0))
        left += width / height
        axes.axvline(left, color="white", linewidth=4, zorder=0.5)
    axes.set(xlim=(0, left), ylim=(1, 0))
    axes.axis("off")
    lines, inliers = np.stack(ends, axis=1), match.estimate.inliers
    chosen = sample(inliers, MAX_INLIERS), sample(~inliers, MAX_OUTLIERS)
    for some, colour, thickness in ((chosen[1], OUTLIER, 0.6), (chosen[0], INLIER, 1.0)):
        axes.add_collection(LineCollection([*lines[some]], colors=colour, linewidths=thickness, alpha=0.75))
        x, y = lines[some].reshape(-1, 2).T
        axes.scatter(x, y, s=5, color=colour, linewidths=0)
    return f"{len(chosen[0])} inliers (green) and {len(chosen[1])} outliers (orange) drawn"


def _draw_clusters(axes: "Axes", image: Image, match: PairMatch, config: MkpcConfig, side: int) -> None:
    _show(axes, image, match.regions and match.regions[side])
    axes.set(xticks=[], yticks=[])
    if match.regions is None:
        axes.set_title("no stage 2: no critical region", loc="left")
        return
    region = match.regions[side]
    stage1 = match.matches[match.in_stage(1)]
    points = stage1.points1 if side else stage1.points0
    clusters = find_clusters(points, image.size, config)
    shown = _upright(image).from_image(points) + 0.5  # from the centres of pixels to their edges
    x, y = shown[~clusters.in_kept].T
    axes.scatter(x, y, s=8, color=DROPPED, marker="x", linewidths=0.7)
    for rank, label in enumerate(clusters.kept):
        x, y = shown[clusters.labels == label].T
        axes.scatter(x, y, s=8, color=COLOURS[rank % len(COLOURS)], linewidths=0)
    share = region.box.area / (image.size.width * image.size.height)
    axes.set_title(
        f"critical region: {region.reason}, {100 * share:.0f} % of the image\n"
        f"{region.kept} of {region.clusters} clusters kept, grey: the other points",
        loc="left",
    )


def _show(
    axes: "Axes", image: Image, region: CriticalRegion | None, scale: float = 1.0, left: float = 0.0
) -> None:
    """Draw an image, upright, and its critical region, its corner at (left, 0) and its pixels ``scale`` wide."""
    from matplotlib.patches import Polygon

    view = _upright(image)
    width, height = view.content
    axes.imshow(view.render(image.pixels), extent=(left, left + scale * width, scale * height, 0))
    if region is not None:
        (x0, y0), (x1, y1) = (region.box.left, region.box.top), (region.box.right, region.box.bottom)
        corners = view.from_image(np.array([(x0, y0), (x0, y1), (x1, y1), (x1, y0)]) - 0.5) + 0.5
        axes.add_patch(Polygon(scale * corners + (left, 0), fill=False, edgecolor=style.REGION, linewidth=2.5))


def _upright(image: Image) -> View:
    """Return the view of the whole image at its own size."""
    return View.fit(Box.whole(image.size), long_side=max(image.size), turns=image.turns)
