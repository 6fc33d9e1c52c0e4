"""Figures that compare recipes: scores, gains, errors."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.evaluation.validate import gain_of
from mkpc_kaggle.geometry.metrics import ROTATION_THRESHOLDS, TRANSLATION_THRESHOLDS
from mkpc_kaggle.pipeline.drawing import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mkpc_kaggle.evaluation.validate import Validation

# The Okabe-Ito palette, suitable for colour-blind readers.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7")
DROPPED = "#999999"
MARKERS = "osD^vPX"
DASHES = ("-", "--", "-.", ":")
PANELS = (  # of draw_errors: kind, unit, thresholds of the mAA, limits of x
    ("rotation", "degrees", ROTATION_THRESHOLDS, (0.05, 180)),
    ("translation", "metres", TRANSLATION_THRESHOLDS, (0.01, 100)),
)


def draw_scores(validations: Sequence["Validation"]) -> "Figure":
    """Draw the mAA of each recipe, one row per scene and one for their mean."""
    figure, axes = _rows(
        [scene.scene for scene in validations[0].scenes], "mAA of each scene, by recipe"
    )
    for index, validation in enumerate(validations):
        values = [*(scene.maa() for scene in validation.scenes), validation.maa()]
        y = _beside(len(values), index, len(validations))
        axes.plot(values, y, **_style(index), linestyle="", label=validation.recipe)
    axes.set(xlim=(-0.02, 1.02), xlabel="mAA")
    _legend_below(figure)
    return figure


def draw_gains(validations: Sequence["Validation"]) -> "Figure":
    """Draw the gain of each recipe over the first, with its interval, one row per scene and one for
    their mean.
    """
    first, *others = validations
    names = [scene.scene for scene in first.scenes]
    figure, axes = _rows(names, f"gain of mAA over {first.recipe}, with 95 % intervals")
    for index, other in enumerate(others):
        found = [gain_of(other, first, name) for name in (*names, None)]
        gains = np.array([each.gain for each in found])
        low = np.array([each.low for each in found])
        high = np.array([each.high for each in found])
        axes.errorbar(
            gains,
            _beside(len(found), index, len(others)),
            xerr=(gains - low, high - gains),
            **_style(index + 1),  # 0 is the style of the first recipe in the other figures
            linestyle="",
            capsize=4,
            label=other.recipe,
        )
    axes.axvline(0, color="black", linewidth=1)
    axes.set_xlabel("gain of mAA; an interval that includes 0 shows no difference")
    _legend_below(figure)
    return figure


def draw_errors(validations: Sequence["Validation"]) -> "Figure":
    """Draw the share of pairs with an error below x, for rotation and for translation."""
    figure = new_figure(9, 4.2)
    for axes, (kind, unit, thresholds, limits) in zip(
        figure.subplots(1, 2, sharey=True), PANELS, strict=True
    ):
        plain_axes(axes, f"pairs with a {kind} error below x")
        axes.axvspan(
            thresholds[0],
            thresholds[-1],
            color=DROPPED,
            alpha=0.2,
            linewidth=0,
            label="thresholds of the mAA",
        )
        for index, validation in enumerate(validations):
            # Failures are infinite: clipped beyond the right edge, so that the curve ends below 1.
            errors = np.clip(
                [getattr(error, kind) for error in validation.errors],
                limits[0],
                2 * limits[1],
            )
            style = {
                "color": _style(index)["color"],
                "linestyle": DASHES[index % len(DASHES)],
            }
            axes.ecdf(errors, **style, linewidth=2, label=validation.recipe)
        axes.set(xscale="log", xlim=limits, ylim=(0, 1.01), xlabel=f"{kind} error in {unit}")
        axes.xaxis.set_major_formatter("{x:g}")
    figure.axes[0].set_ylabel("share of the pairs")
    _legend_below(figure)
    return figure


def _rows(scenes: Sequence[str], title: str) -> "tuple[Figure, Axes]":
    """Return axes with one row per scene, the first on top, and a separate row for their mean."""
    names = [*map(short, scenes), "mean over scenes"]
    figure = new_figure(8, 1.5 + 0.45 * len(names))
    axes = plain_axes(figure.subplots(), title)
    axes.set_yticks(range(len(names)), names, parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.axhline(len(names) - 1.5, color=DROPPED, linewidth=0.8)
    axes.grid(axis="x", color=DROPPED, alpha=0.3)
    return figure, axes


def _beside(rows: int, index: int, count: int) -> NDArray[np.float64]:
    """Return the (rows,) y coordinates of the marks of recipe ``index`` of the ``count`` in each
    row.
    """
    return np.arange(rows, dtype=np.float64) + 0.5 * ((index + 0.5) / count - 0.5)


def _style(index: int) -> dict[str, Any]:
    """Return the style of a recipe by its index, the same in all figures.

    Six colours and seven markers give 42 styles, so that shapes distinguish recipes for
    colour-blind readers.
    """
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "markersize": 7,
    }


def _legend_below(figure: "Figure") -> None:
    handles, names = figure.axes[0].get_legend_handles_labels()
    if names:
        figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)


def short(name: str, most: int = 18) -> str:
    """Return a name of up to ``most`` letters."""
    return name if len(name) <= most else name[: most - 1] + "…"


def plain_axes(axes: "Axes", title: str) -> "Axes":
    """Return the axes with a title on the left and without the top and right edges of the frame."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return axes
