"""Figures of a pair: matches and critical regions, in matplotlib."""

from math import sqrt
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import evenly_spread
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Box, View
from mkpc_kaggle.pipeline.pair import PairMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The Okabe-Ito palette, suitable for colour-blind readers.
INLIER, OUTLIER, REGION = "#009E73", "#D55E00", "#F0E442"
DPI = 110
STRIP_HEIGHT_PX = 480
MAX_STRIP_PX = 2_000_000  # a panorama would otherwise make a picture of many megabytes
# Maximum numbers of lines in a legible figure
MAX_INLIERS = 150
MAX_OUTLIERS = 50


def draw_pair(images: tuple[Image, Image], match: PairMatch) -> "Figure":
    """Draw the matches of all units and the critical regions, with the counts as title."""
    figure = new_figure(12, 5)  # inches: legible on a screen of 1,320 pixels
    axes = figure.subplots()
    draw_matches(axes, images, match)
    counts = f"{plural(len(match.matches), 'match')}, {plural(match.estimate.inlier_count, 'inlier')}"
    failure = f"; {match.estimate.failure}" if match.estimate.failure else ""
    axes.set_title(f"{counts} (green){failure}", loc="left")
    return figure


def draw_strip(images: tuple[Image, Image], match: PairMatch) -> "Figure":
    """Draw the matches and the critical regions without text, in up to :data:`MAX_STRIP_PX` pixels."""
    aspect = sum(view.content.width / view.content.height for view in map(_upright, images))
    height = min(STRIP_HEIGHT_PX, sqrt(MAX_STRIP_PX / aspect)) / DPI
    # A layout would leave a margin for text that a strip does not have, and draw everything twice.
    figure = new_figure(aspect * height, height, layout=None)
    draw_matches(figure.add_axes((0, 0, 1, 1)), images, match, round(height * DPI))
    return figure


def draw_matches(
    axes: "Axes", images: tuple[Image, Image], match: PairMatch, height_px: int | None = None
) -> None:
    """Draw the images side by side, matches as lines, and critical regions as boxes.

    Of many matches, an even sample is drawn. In axes coordinates, each image is one unit high.
    Images are reduced to ``height_px``, if given: matplotlib takes several times as long to do it.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    ends: list[NDArray[np.float64]] = []
    left = 0.0
    for side, points in enumerate((match.matches.points0, match.matches.points1)):
        view = _upright(images[side], height_px)
        width, height = view.content
        # (0, 0) is the centre of a pixel, and the corner of the picture
        extent = (left, left + width / height, 1, 0)
        axes.imshow(view.render(images[side].pixels), extent=extent)
        if match.regions:
            box = match.regions[side].box
            x = np.array([box.left, box.left, box.right, box.right])
            y = np.array([box.top, box.bottom, box.bottom, box.top])
            # A box has borders of pixels, a view maps centres. A view may be turned.
            corners = (view.from_image(np.column_stack([x, y]) - 0.5) + 0.5) / height + (
                left,
                0,
            )
            axes.add_patch(Polygon(corners, fill=False, edgecolor=REGION, linewidth=2.5))
        ends.append((view.from_image(points) + 0.5) / height + (left, 0))
        left += width / height
        # A gap between the images, below the lines
        axes.axvline(left, color="white", linewidth=4, zorder=0.5)
    axes.set(xlim=(0, left), ylim=(1, 0))
    axes.axis("off")
    lines = np.stack(ends, axis=1)
    inliers = sample(match.estimate.inliers, MAX_INLIERS)
    outliers = sample(~match.estimate.inliers, MAX_OUTLIERS)
    # Inliers last: they lie above the others.
    for some, colour, thickness in ((outliers, OUTLIER, 0.6), (inliers, INLIER, 1.0)):
        axes.add_collection(
            LineCollection([*lines[some]], colors=colour, linewidths=thickness, alpha=0.75)
        )
        x, y = lines[some].reshape(-1, 2).T
        axes.scatter(x, y, s=5, color=colour, linewidths=0)


def _upright(image: Image, height_px: int | None = None) -> View:
    """Return the upright view of the whole image, up to ``height_px`` high if given."""
    width, height = image.size
    upright_height = width if image.turns % 2 else height
    reduction = min(1.0, (height_px or upright_height) / upright_height)
    long_side = round(max(image.size) * reduction)
    return View.fit(Box.whole(image.size), long_side=long_side, turns=image.turns)


def new_figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> "Figure":
    """Return an empty figure of this size in inches. Raise :class:`UserError` without matplotlib."""
    # Without pyplot, which would choose a window system and keep all figures in memory.
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError(
            "figures need matplotlib: pip install 'mkpc-kaggle[plots]'"
        ) from error
    return Figure(figsize=(width, height), layout=layout)


def sample(mask: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """Return up to ``most`` evenly spread indices of the mask's true elements."""
    return np.array(evenly_spread(np.flatnonzero(mask).tolist(), most), np.intp)
