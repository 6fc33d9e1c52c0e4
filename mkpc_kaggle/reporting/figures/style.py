"""Common parts of all figures: colours, an empty figure, plain axes, and output formats."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import evenly_spread
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The Okabe-Ito palette, suitable for colour-blind readers.
INLIER, OUTLIER, REGION, DROPPED = "#009E73", "#D55E00", "#F0E442", "#999999"
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7")
DPI = 110


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of this size in inches. Raise :class:`UserError` without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("figures need matplotlib: pip install 'mkpc-kaggle[plots]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def require_format(path: Path) -> None:
    """Raise :class:`UserError` for a suffix that is not a format of matplotlib, or without matplotlib."""
    formats = new_figure(1, 1).canvas.get_supported_filetypes().keys() - {"pgf"}  # which needs LaTeX
    if path.suffix[1:].lower() not in formats:
        raise UserError(f"the figure {path} needs a suffix: one of {', '.join(sorted(formats))}")


def save(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of its suffix. Raises :class:`UserError` if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            figure.savefig(stream.buffer, format=path.suffix[1:].lower(), dpi=DPI)
    except (OSError, ValueError) as error:
        raise UserError(f"the figure {path} cannot be written: {error}") from error


def encode(figure: "Figure", kind: str, dpi: int = DPI) -> bytes:
    """Return the figure as "png", for lines and text, or "jpeg", for photographs."""
    stream = BytesIO()
    figure.savefig(stream, format=kind, dpi=dpi, pil_kwargs={"quality": 82} if kind == "jpeg" else None)
    return stream.getvalue()


def plain(axes: "Axes", title: str) -> "Axes":
    """Return axes with a title on the left, and without a frame at the top and on the right."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def short(name: str, most: int = 18) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def sample(mask: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """Return up to ``most`` indices of a mask, evenly spread."""
    return np.array(evenly_spread(np.flatnonzero(mask).tolist(), most), np.intp)
