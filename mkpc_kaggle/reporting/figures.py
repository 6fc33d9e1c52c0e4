"""Figures of pairs and of a scene's cameras, and their files."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.store.records import SceneRecord
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.pipeline.drawing import (
    COLOURS,
    DPI,
    DROPPED,
    INLIER,
    OUTLIER,
    REGION,
    draw_matches,
    draw_pair,
    draw_strip,
    new_figure,
    sample,
)
from mkpc_kaggle.scene.models import SfmModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Figures of a pair are drawn below this layer, for programs.
__all__ = [
    "COLOURS",
    "DPI",
    "DROPPED",
    "INLIER",
    "OUTLIER",
    "REGION",
    "draw_cameras",
    "draw_matches",
    "draw_pair",
    "draw_strip",
    "encode",
    "new_figure",
    "plain_axes",
    "require_format",
    "sample",
    "save",
]


def draw_cameras(scene: SceneRecord, number: int = 0) -> "Figure":
    """Draw a model's cameras and points, in model units, from above and the side; number 0 is the
    largest.

    An arrow shows the viewing direction of a camera. Up is the images' mean up direction, and ahead
    is the mean viewing direction. Points far from nearly all others are left out. Without cameras,
    the figure is only text.
    """
    figure = new_figure(8.4, 4.0)
    if not scene.models:
        figure.text(0.5, 0.5, f"no cameras: {scene.failure}", ha="center", wrap=True)
        return figure
    model = scene.models[number]
    right, up, ahead = _upright_axes([found.camera for found in model.images])
    from_above, from_the_side = figure.subplots(1, 2)
    _draw_projected(from_above, "above", model, np.column_stack([right, ahead]))
    _draw_projected(from_the_side, "the side", model, np.column_stack([ahead, up]))
    return figure


def _upright_axes(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the unit vectors (3, 3) right, up and ahead of the mean camera, in the model's world."""
    # A model's axes are arbitrary, but photographs are mostly taken upright.
    _, down, forward = np.mean([camera.R for camera in cameras], axis=0)
    up = -down / np.linalg.norm(down)
    ahead = forward - forward @ up * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), up, ahead])


def _draw_projected(panel: "Axes", name: str, model: SfmModel, axes: NDArray[np.float64]) -> None:
    """Draw a model's cameras and points as seen from ``name``, projected on ``axes`` (3, 2)."""
    cameras = [found.camera for found in model.images]
    plain_axes(panel, f"{plural(len(cameras), 'camera')} from {name}")
    points = model.points @ axes
    # A few points of wrong matches lie far away and would shrink all others.
    near = _near(points[:, 0]) & _near(points[:, 1])
    panel.scatter(points[near, 0], points[near, 1], s=2, color=DROPPED, linewidths=0)
    centres = np.array([camera.centre for camera in cameras])
    # Cameras at one point still have arrows.
    arrow = 0.12 * (np.ptp(centres, axis=0).max() or 1.0)
    looks = arrow * np.array([camera.R[2] for camera in cameras])
    x, y = (centres @ axes).T
    panel.quiver(
        x,
        y,
        *(looks @ axes).T,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.004,
        color=COLOURS[0],
    )
    # Above the arrows and the points
    panel.scatter(x, y, s=14, color=OUTLIER, linewidths=0, zorder=3)
    # One scale for both axes, and the panel filled
    panel.set_aspect("equal", adjustable="datalim")
    panel.margins(0.1)


def _near(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the values in or near the range of nearly all values."""
    low, high = np.percentile(values, (3, 97)) if len(values) else (0.0, 0.0)
    # 40 % beyond the range on both sides
    near: NDArray[np.bool_] = np.abs(values - (low + high) / 2) <= 0.7 * (high - low)
    return near


def require_format(path: Path) -> None:
    """Raise :class:`UserError` if matplotlib is missing or does not support the suffix as a format."""
    # Before hours of matching, and not after them
    formats = new_figure(1, 1).canvas.get_supported_filetypes().keys() - {"pgf"}  # pgf needs LaTeX
    if path.suffix[1:].lower() not in formats:
        raise UserError(f"the figure {path} needs a suffix: one of {', '.join(sorted(formats))}")


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


def encode(figure: "Figure", kind: str, dpi: int = DPI) -> bytes:
    """Return the encoded figure; ``kind`` is "png" for lines and text, or "jpeg" for photographs."""
    stream = BytesIO()
    # Photographs as PNG would be many times as large.
    options = {"quality": 82} if kind == "jpeg" else None
    figure.savefig(stream, format=kind, dpi=dpi, pil_kwargs=options)
    return stream.getvalue()


def plain_axes(axes: "Axes", title: str) -> "Axes":
    """Return the axes with a title on the left and without the top and right edges of the frame."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return axes
