"""Files of figures."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.drawing import DPI, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def require_format(path: Path) -> None:
    """Raise :class:`UserError` if matplotlib is missing or does not support the suffix as a format."""
    # Before hours of matching, and not after them
    # Pgf needs LaTeX
    formats = new_figure(1, 1).canvas.get_supported_filetypes().keys() - {"pgf"}
    if path.suffix[1:].lower() not in formats:
        raise UserError(
            f"the figure {path} needs a suffix: one of {', '.join(sorted(formats))}"
        )


def save(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of the path's suffix. Raises :class:`UserError` if writing
    fails.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as stream:
            figure.savefig(stream.buffer, format=path.suffix[1:].lower(), dpi=DPI)
    except (OSError, ValueError) as error:
        raise UserError(f"the figure {path} cannot be written: {error}") from error


def encode(figure: "Figure", dpi: int = DPI) -> bytes:
    """Return the figure as JPEG: photographs as PNG would be many times as large."""
    stream = BytesIO()
    figure.savefig(stream, format="jpeg", dpi=dpi, pil_kwargs={"quality": 82})
    return stream.getvalue()
