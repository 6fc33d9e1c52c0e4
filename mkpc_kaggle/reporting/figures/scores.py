"""How well recipes do: scores, gains, errors."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.metrics import ROTATION_THRESHOLDS, TRANSLATION_THRESHOLDS
from mkpc_kaggle.reporting.figures.canvas import CYCLE, DROPPED, INK, new_figure, plain, plain_axes, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mkpc_kaggle.evaluation.compare import Comparison
    from mkpc_kaggle.evaluation.validate import Validation


MARKERS = "osD^vPX"
DASHES = ("-", "--", "-.", ":")


def draw_scores(validations: Sequence["Validation"]) -> "Figure":
    """A row a scene and one for their mean, a mark a recipe: its mAA."""
    scenes = [scene.scene for scene in validations[0].scenes]
    figure, axes = _rows([*scenes, "mean over scenes"], "mAA of each scene, by recipe")
    for place, one in enumerate(validations):
        style = _style(place)
        values = [*(scene.maa for scene in one.scenes), one.maa]
        axes.plot(values, _beside(len(values), place, len(validations)), **style, linestyle="", label=one.recipe)
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("mAA", color=INK)
    _legend_below(figure)
    return figure


def draw_gains(comparison: "Comparison") -> "Figure":
    """A row a scene and one for their mean: what each recipe gains over the first, with its interval."""
    first, *others = comparison.validations
    names = [*comparison.scenes, "mean over scenes"]
    figure, axes = _rows(names, f"gain of mAA over {first.recipe}, with 95 % intervals")
    for place, other in enumerate(others):
        style = _style(place + 1)
        scenes = [comparison.difference(place + 1, name) for name in comparison.scenes]
        found = [*scenes, comparison.difference(place + 1)]
        reach = [[one.gain - one.low for one in found], [one.high - one.gain for one in found]]
        y = _beside(len(found), place, len(others))
        axes.errorbar(
            [one.gain for one in found], y, xerr=reach, **style, linestyle="", capsize=4, label=other.recipe
        )
    axes.axvline(0, color=INK, linewidth=1)
    axes.set_xlabel("mAA gained; an interval that holds 0 proves nothing", color=INK)
    _legend_below(figure)
    return figure


def draw_errors(validations: Sequence["Validation"]) -> "Figure":
    """Two panels: the share of pairs whose rotation, and whose translation, is less than x off."""
    figure = new_figure(9, 4.2)
    panels = figure.subplots(1, 2, sharey=True)
    kinds = (
        ("rotation", "degrees", ROTATION_THRESHOLDS, (0.05, 180)),
        ("translation", "metres", TRANSLATION_THRESHOLDS, (0.01, 100)),
    )
    for axes, (kind, measure, thresholds, limits) in zip(panels, kinds, strict=True):
        plain(axes, f"pairs whose {kind} is less than x off")
        axes.axvspan(thresholds[0], thresholds[-1], color=DROPPED, alpha=0.2, linewidth=0)
        middle = float(np.sqrt(thresholds[0] * thresholds[-1]))
        axes.text(middle, 2, "thresholds\nof the mAA", ha="center", va="bottom", fontsize=9, color=INK)
        for place, one in enumerate(validations):
            colour, dashes = _style(place)["color"], DASHES[place % len(DASHES)]
            x, share = _cumulated([getattr(error, kind) for error in one.errors], limits)
            axes.step(x, share, where="post", color=colour, linestyle=dashes, linewidth=2, label=one.recipe)
        axes.set(xscale="log", xlim=limits, ylim=(0, 101))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel(f"{kind} error in {measure}", color=INK)
    panels[0].set_ylabel("per cent of the pairs", color=INK)
    _legend_below(figure)
    return figure


def _cumulated(
    errors: Sequence[float], limits: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A curve of x and the per cent of errors up to x, between the limits; failures are infinite."""
    x = np.clip(np.sort(np.asarray(errors, np.float64)), limits[0], None)
    x = x[x < limits[1]]
    share = 100 * np.arange(len(x) + 1) / max(1, len(errors))
    return np.concatenate([[limits[0]], x, [limits[1]]]), np.append(share, share[-1])


def _rows(names: Sequence[str], title: str) -> "tuple[Figure, Axes]":
    """Axes with a row a name, the first on top; a line sets the last, which sums the others up, apart."""
    figure = new_figure(8, 1.5 + 0.45 * len(names))
    axes = plain_axes(figure, title)
    axes.set_yticks(range(len(names)), [short(name) for name in names], parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.axhline(len(names) - 1.5, color=DROPPED, linewidth=0.8)
    axes.grid(axis="x", color=DROPPED, alpha=0.3)
    return figure, axes


def _beside(rows: int, place: int, places: int) -> NDArray[np.float64]:
    """(rows,) heights of the marks at one of several places that share each row."""
    return np.arange(rows, dtype=np.float64) + 0.5 * ((place + 0.5) / places - 0.5)


def _style(place: int) -> dict[str, Any]:
    """The style of a recipe, by its place, the same in all figures; told apart by shape, too; 42 in all."""
    return {"color": CYCLE[place % len(CYCLE)], "marker": MARKERS[place % len(MARKERS)], "markersize": 7}


def _legend_below(figure: "Figure") -> None:
    handles, names = figure.axes[0].get_legend_handles_labels()
    if names:
        figure.legend(handles, names, loc="outside lower center", ncols=3, labelcolor=INK, frameon=False)
