"""What all figures share: colours, empty canvases, and the ways to write them.

Colours are the Okabe-Ito palette, which colour-blind readers can tell apart.
"""

import warnings
from collections.abc import Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INLIER, OUTLIER, REGION, DROPPED = "#009E73", "#D55E00", "#F0E442", "#999999"
CLUSTERS = ("#56B4E9", "#E69F00", "#CC79A7", "#0072B2", "#009E73", "#D55E00")
CYCLE = tuple(CLUSTERS[place] for place in (3, 1, 4, 5, 0, 2))
INK = "#010203"
"""Stands for the colour of the text around a figure, until :func:`to_svg` makes it just that."""
WIDTH = 10.0
"""Inches across a notebook."""
MOST_LINES = 150
"""Lines that an eye can follow; a figure with more matches shows an even sample and says so."""


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


def to_svg(figure: "Figure") -> str:
    """The figure as an ``<svg>`` element that takes over the colour of the text around it; fixed bytes."""
    from matplotlib import rc_context

    stream = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "mkpc"}), warnings.catch_warnings():
        # The reader's browser has the glyphs that matplotlib's own font lacks.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    text = stream.getvalue()
    return text[text.index("<svg") :].replace(INK, "currentColor")


def to_jpeg(figure: "Figure", dpi: int = 110) -> bytes:
    stream = BytesIO()
    figure.savefig(stream, format="jpeg", dpi=dpi, pil_kwargs={"quality": 82})
    return stream.getvalue()


def plain_axes(figure: "Figure", title: str) -> "Axes":
    return plain(figure.subplots(), title)


def plain(axes: "Axes", title: str) -> "Axes":
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.tick_params(colors=INK, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_color(INK)
        spine.set_visible(side in ("left", "bottom"))
    axes.patch.set_alpha(0)
    return axes


def legend(axes: "Axes") -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(labelcolor=INK, fontsize=8, frameon=False, loc="best")


def short(name: str, most: int = 18) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def add_box(axes: "Axes", box: Box, **style: Any) -> None:
    """Frame a box of image pixels; ``style`` is matplotlib's."""
    add_rectangle(axes, (box.left - 0.5, box.top - 0.5), box.size.width, box.size.height, **style)


def add_rectangle(axes: "Axes", corner: tuple[float, float], width: float, height: float, **style: Any) -> None:
    from matplotlib.patches import Rectangle

    style = {"edgecolor": REGION, "linewidth": 2.5, **style}
    axes.add_patch(Rectangle(corner, width, height, fill=False, **style))


def show(axes: "Axes", image: Image) -> None:
    axes.imshow(image.pixels)
    axes.set_xticks([])
    axes.set_yticks([])


def side_by_side(images: Sequence[Image], title_lines: int = 1) -> "tuple[Figure, Sequence[Axes]]":
    """Pictures in a row at one height, as wide as a notebook, with room for titles of that many lines above."""
    aspects = [image.size.width / image.size.height for image in images]
    height = min((WIDTH - 0.1 * (len(images) + 1)) / sum(aspects), 5.0)
    gap = (WIDTH - height * sum(aspects)) / (len(images) + 1)
    total = 0.1 + height + 0.15 + 0.17 * title_lines
    figure = new_figure(WIDTH, total)
    figure.set_layout_engine(
        "none"
    )  # the places are known, and room would be lost around pictures of fixed aspect
    row, left = [], gap
    for image, aspect in zip(images, aspects, strict=True):
        axes = figure.add_axes((left / WIDTH, 0.1 / total, height * aspect / WIDTH, height / total))
        show(axes, image)
        row.append(axes)
        left += height * aspect + gap
    return figure, row


def sample(mask: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """At most ``most`` indices of a mask, evenly spread."""
    indices: NDArray[np.intp] = np.flatnonzero(mask)
    if len(indices) <= most:
        return indices
    chosen: NDArray[np.intp] = indices[np.linspace(0, len(indices) - 1, most).round().astype(int)]
    return chosen
