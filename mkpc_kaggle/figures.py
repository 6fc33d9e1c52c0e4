"""Figures, drawn with matplotlib: everything that this package paints is painted here.

Colours are the Okabe-Ito palette, which colour-blind readers can tell apart.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO, StringIO
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.critical_region import MkpcConfig, cluster_points, keep_clusters
from mkpc_kaggle.geometry.metrics import ROTATION_THRESHOLDS, TRANSLATION_THRESHOLDS
from mkpc_kaggle.images import Image
from mkpc_kaggle.pipeline import PairMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mkpc_kaggle.compare import Comparison
    from mkpc_kaggle.validate import Validation

INLIER, OUTLIER, REGION, DROPPED = "#009E73", "#D55E00", "#F0E442", "#999999"
CLUSTERS = ("#56B4E9", "#E69F00", "#CC79A7", "#0072B2", "#009E73", "#D55E00")
_CYCLE = tuple(CLUSTERS[place] for place in (3, 1, 4, 5, 0, 2))
INK = "#010203"
"""Stands for the colour of the text around a figure, until :func:`to_svg` makes it just that."""
MOST_EMPTY = 4
"""How many times as long as the run a time limit may be to be drawn beside it."""
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


def to_jpeg(figure: "Figure") -> bytes:
    stream = BytesIO()
    figure.savefig(stream, format="jpeg", dpi=110, pil_kwargs={"quality": 82})
    return stream.getvalue()


def draw_parts(parts: Mapping[str, float]) -> "Figure":
    """Bars: the seconds of each part of the work."""
    figure = new_figure(5.6, 0.5 + 0.32 * max(1, len(parts)))
    axes = _plain_axes(figure, f"{sum(parts.values()):.0f} seconds of work, by part")
    bars = axes.barh(list(parts), list(parts.values()), color=CLUSTERS[3], height=0.65)
    axes.bar_label(bars, fmt="%.1f", padding=3, color=INK, fontsize=9)
    axes.margins(x=0.12)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    return figure


def draw_budget(
    ended: Mapping[str, Sequence[float]], marks: Mapping[str, Sequence[float]], limit: float | None
) -> "Figure":
    """Jobs ended over time, one colour a phase: ``ended`` and ``marks`` are seconds since the start by name.

    A limit that the run came nowhere near is told and not drawn: the jobs would have no room beside it.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(5.6, 3.2)
    latest = max((second for times in (*ended.values(), *marks.values()) for second in times), default=0.0)
    is_near = limit is not None and limit < MOST_EMPTY * latest
    unit, name = _time_unit(limit if limit is not None and is_near else latest)
    total = sum(map(len, ended.values()))
    axes = _plain_axes(figure, f"{total} jobs ended, over {name} since the start{_far(limit, is_near)}")
    below = 0
    for colour, (phase, times) in zip(_CYCLE, ended.items(), strict=False):
        # A flat piece is time without a result; 300 steps are as many as can be seen.
        keep = _sample(np.ones(len(times), bool), 300)
        x, y = [times[i] / unit for i in keep], [below + i + 1 for i in keep]
        axes.step(x, y, where="post", color=colour, linewidth=2, label=phase, marker="o", markersize=2.5)
        below += len(times)
    for colour, style, (what, times) in zip((CLUSTERS[2], OUTLIER), (":", "--"), marks.items(), strict=False):
        for number, second in enumerate(times[:MOST_LINES]):
            label = what if number == 0 else None
            axes.axvline(second / unit, color=colour, linewidth=1, linestyle=style, label=label)
    if limit is not None and is_near:
        axes.axvline(limit / unit, color=INK, linewidth=1.2, label="time limit")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(name, color=INK)
    _legend(axes)
    return figure


def _far(limit: float | None, is_near: bool) -> str:
    if limit is None or is_near:
        return ""
    unit, name = _time_unit(limit)
    return f"; the limit is {limit / unit:.3g} {name}"


def draw_groups(groups: Mapping[str, Sequence[int]]) -> "Figure":
    """A row a group, a dot a pair, a bar the median: inliers on a scale that grows by factors."""
    figure = new_figure(5.6, 0.9 + 0.26 * max(1, len(groups)))
    axes = _plain_axes(figure, "inliers of each pair, by batch; the line is the median")
    for row, inliers in enumerate(groups.values()):
        spread = np.linspace(-0.25, 0.25, len(inliers)) if len(inliers) > 1 else [0.0]
        some = _sample(np.ones(len(inliers), bool), 120)
        axes.scatter(
            np.asarray(inliers)[some],
            row + np.asarray(spread)[some],
            s=16,
            color=CLUSTERS[0],
            alpha=0.7,
            linewidths=0,
        )
        axes.vlines(np.median(inliers), row - 0.36, row + 0.36, color=OUTLIER, linewidth=2)
    axes.set_yticks(range(len(groups)), [_short(name) for name in groups], parse_math=False, fontsize=8)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_xscale("symlog", linthresh=10)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter("{x:.0f}")
    return figure


def draw_crops(sizes: Mapping[str, Sequence[tuple[int, int]]]) -> "Figure":
    """A dot a region at its width and height in pixels, one colour a reason."""
    figure = new_figure(5.6, 3.6)
    total = sum(map(len, sizes.values()))
    axes = _plain_axes(figure, f"{total} critical regions: width and height in pixels, by reason")
    for colour, (reason, values) in zip(_CYCLE, sizes.items(), strict=False):
        some = _sample(np.ones(len(values), bool), 500)
        x, y = np.asarray(values)[some].T
        axes.scatter(x, y, s=12, color=colour, alpha=0.6, linewidths=0, label=f"{reason} ({len(values)})")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("width", color=INK)
    axes.set_ylabel("height", color=INK)
    _legend(axes)
    return figure


def draw_scores(validations: Sequence["Validation"]) -> "Figure":
    """A row a scene and one for their mean, a mark a recipe: its mAA."""
    scenes = [scene.scene for scene in validations[0].scenes]
    figure, axes = _rows([*scenes, "mean over scenes"], "mAA of each scene, by recipe")
    for place, (style, one) in enumerate(zip(_styles(), validations, strict=False)):
        values = [*(scene.maa for scene in one.scenes), one.maa]
        axes.plot(values, _beside(len(values), place, len(validations)), **style, linestyle="", label=one.recipe)
    axes.set_xlim(0, 1)
    axes.set_xlabel("mAA", color=INK)
    _legend_below(figure)
    return figure


def draw_gains(comparison: "Comparison") -> "Figure":
    """A row a scene and one for their mean: what each recipe gains over the first, with its interval."""
    first, *others = comparison.validations
    names = [*comparison.scenes, "mean over scenes"]
    figure, axes = _rows(names, f"gain of mAA over {first.recipe}, with 95 % intervals")
    for place, (style, other) in enumerate(zip(_styles(1), others, strict=False)):
        scenes = [comparison.difference(place + 1, name) for name in comparison.scenes]
        found = [*scenes, comparison.difference(place + 1)]
        reach = [[one.gain - one.low for one in found], [one.high - one.gain for one in found]]
        y = _beside(len(found), place, len(others))
        axes.errorbar(
            [one.gain for one in found], y, xerr=reach, **style, linestyle="", capsize=4, label=other.recipe
        )
    axes.axvline(0, color=INK, linewidth=1)
    axes.set_xlabel("mAA gained; an interval that holds 0 tells nothing apart", color=INK)
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
        _plain(axes, f"pairs whose {kind} is less than x off")
        axes.axvspan(thresholds[0], thresholds[-1], color=DROPPED, alpha=0.2, linewidth=0)
        axes.text(
            *(np.sqrt(thresholds[0] * thresholds[-1]), 2),
            "thresholds\nof the mAA",
            ha="center",
            va="bottom",
            fontsize=9,
            color=INK,
        )
        for style, dashes, one in zip(_styles(), cycle(("-", "--", "-.", ":")), validations, strict=False):
            x, share = _cumulated([getattr(error, kind) for error in one.errors], limits)
            axes.step(
                x, share, where="post", color=style["color"], linestyle=dashes, linewidth=2, label=one.recipe
            )
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
    axes = _plain_axes(figure, title)
    axes.set_yticks(range(len(names)), [_short(name) for name in names], parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.axhline(len(names) - 1.5, color=DROPPED, linewidth=0.8)
    axes.grid(axis="x", color=DROPPED, alpha=0.3)
    return figure, axes


def _beside(rows: int, place: int, places: int) -> NDArray[np.float64]:
    """(rows,) heights of the marks at one of several places that share each row."""
    return np.arange(rows, dtype=np.float64) + 0.5 * ((place + 0.5) / places - 0.5)


def _styles(start: int = 0) -> Iterator[dict[str, Any]]:
    """One for each recipe, the same in all figures; told apart by shape, too; 42 before they return."""
    for colour, marker in islice(zip(cycle(_CYCLE), cycle("osD^vPX"), strict=False), start, None):
        yield {"color": colour, "marker": marker, "markersize": 7}


def _legend_below(figure: "Figure") -> None:
    handles, names = figure.axes[0].get_legend_handles_labels()
    if names:
        figure.legend(handles, names, loc="outside lower center", ncols=3, labelcolor=INK, frameon=False)


def draw_strip(images: tuple[Image, Image], match: PairMatch) -> "Figure":
    """The two images side by side at one height: lines are matches, boxes the critical regions; no text."""
    height = 480
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
    for region, scale, shift in zip(match.regions or (), scales, (0, widths[0]), strict=False):
        box = region.box
        left, top = box.left * scale + shift - 0.5, box.top * scale - 0.5
        axes.add_patch(_rectangle(left, top, box.size.width * scale, box.size.height * scale))
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
        drawn = lines[_sample(mask, most)]
        axes.add_collection(LineCollection(list(drawn), colors=colour, linewidths=width, alpha=0.75))
        x, y = drawn.reshape(-1, 2).T
        axes.scatter(x, y, s=5, color=colour, linewidths=0)


def _plain_axes(figure: "Figure", title: str) -> "Axes":
    return _plain(figure.subplots(), title)


def _plain(axes: "Axes", title: str) -> "Axes":
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.tick_params(colors=INK, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_color(INK)
        spine.set_visible(side in ("left", "bottom"))
    axes.patch.set_alpha(0)
    return axes


def _legend(axes: "Axes") -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(labelcolor=INK, fontsize=8, frameon=False, loc="best")


def _time_unit(seconds: float) -> tuple[float, str]:
    return next((pair for pair in ((3600, "hours"), (60, "minutes")) if seconds > 3 * pair[0]), (1, "seconds"))


def _short(name: str, most: int = 18) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


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
