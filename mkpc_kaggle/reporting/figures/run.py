"""What a run did: time, budget, inliers, crops."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.reporting.figures.canvas import (
    CLUSTERS,
    CYCLE,
    DROPPED,
    INK,
    MOST_LINES,
    OUTLIER,
    legend,
    new_figure,
    plain,
    plain_axes,
    sample,
    short,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mkpc_kaggle.engine.records import CameraRecord, SceneRecord

MOST_EMPTY = 4
"""How many times as long as the run a time limit may be to be drawn beside it."""


def draw_parts(parts: Mapping[str, float]) -> "Figure":
    """Bars: the seconds of each part of the work."""
    figure = new_figure(5.6, 0.5 + 0.32 * max(1, len(parts)))
    axes = plain_axes(figure, f"{sum(parts.values()):.0f} seconds of work, by part")
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

    A limit that the run came nowhere near is in the title and not drawn: the jobs would have no room beside it.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(5.6, 3.2)
    latest = max((second for times in (*ended.values(), *marks.values()) for second in times), default=0.0)
    is_near = limit is not None and limit < MOST_EMPTY * latest
    unit, name = _time_unit(limit if limit is not None and is_near else latest)
    total = sum(map(len, ended.values()))
    axes = plain_axes(figure, f"{total} jobs ended, over {name} since the start{_far(limit, is_near)}")
    below = 0
    for place, (phase, times) in enumerate(ended.items()):
        colour = CYCLE[place % len(CYCLE)]
        # A flat piece is time without a result; 300 steps are as many as can be seen.
        keep = sample(np.ones(len(times), bool), 300)
        x, y = [times[i] / unit for i in keep], [below + i + 1 for i in keep]
        axes.step(x, y, where="post", color=colour, linewidth=2, label=phase, marker="o", markersize=2.5)
        below += len(times)
    styles = (CLUSTERS[2], ":"), (OUTLIER, "--")
    for place, (what, times) in enumerate(marks.items()):
        colour, style = styles[place % len(styles)]
        for number, second in enumerate(times[:MOST_LINES]):
            label = what if number == 0 else None
            axes.axvline(second / unit, color=colour, linewidth=1, linestyle=style, label=label)
    if limit is not None and is_near:
        axes.axvline(limit / unit, color=INK, linewidth=1.2, label="time limit")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(name, color=INK)
    legend(axes)
    return figure


def _far(limit: float | None, is_near: bool) -> str:
    if limit is None or is_near:
        return ""
    unit, name = _time_unit(limit)
    return f"; the limit is {limit / unit:.3g} {name}"


def draw_upgrades(before: Sequence[int], after: Sequence[int]) -> "Figure":
    """A dot a pair: its inliers before and after it was upgraded; above the line it has more."""
    figure = new_figure(5.6, 3.8)
    axes = plain_axes(figure, f"inliers of {len(before)} upgraded pairs, before and after")
    some = sample(np.ones(len(before), bool), 500)
    axes.scatter(
        np.asarray(before)[some], np.asarray(after)[some], s=16, color=CLUSTERS[3], alpha=0.7, linewidths=0
    )
    most = 1.3 * max(10, *before, *after)
    axes.plot([0, most], [0, most], color=OUTLIER, linewidth=1, linestyle="--", label="as before")
    for scale, limit, name in (
        (axes.set_xscale, axes.set_xlim, axes.xaxis),
        (axes.set_yscale, axes.set_ylim, axes.yaxis),
    ):
        scale("symlog", linthresh=10)
        limit(0, most)
        name.set_major_formatter("{x:.0f}")
    axes.set_xlabel("before", color=INK)
    axes.set_ylabel("after", color=INK)
    legend(axes)
    return figure


def draw_groups(groups: Mapping[str, Sequence[int]]) -> "Figure":
    """A row a group, a dot a pair, a bar the median: inliers on a scale that grows by factors."""
    figure = new_figure(5.6, 0.9 + 0.26 * max(1, len(groups)))
    axes = plain_axes(figure, "inliers of each pair, by batch; the line is the median")
    for row, inliers in enumerate(groups.values()):
        spread = np.linspace(-0.25, 0.25, len(inliers)) if len(inliers) > 1 else [0.0]
        some = sample(np.ones(len(inliers), bool), 120)
        axes.scatter(
            np.asarray(inliers)[some],
            row + np.asarray(spread)[some],
            s=16,
            color=CLUSTERS[0],
            alpha=0.7,
            linewidths=0,
        )
        axes.vlines(np.median(inliers), row - 0.36, row + 0.36, color=OUTLIER, linewidth=2)
    axes.set_yticks(range(len(groups)), [short(name) for name in groups], parse_math=False, fontsize=8)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_xscale("symlog", linthresh=10)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter("{x:.0f}")
    return figure


def draw_crops(sizes: Mapping[str, Sequence[tuple[int, int]]]) -> "Figure":
    """A dot a region at its width and height in pixels, one colour a reason."""
    figure = new_figure(5.6, 3.6)
    total = sum(map(len, sizes.values()))
    axes = plain_axes(figure, f"{total} critical regions: width and height in pixels, by reason")
    for place, (reason, values) in enumerate(sizes.items()):
        colour = CYCLE[place % len(CYCLE)]
        some = sample(np.ones(len(values), bool), 500)
        x, y = np.asarray(values)[some].T
        axes.scatter(x, y, s=12, color=colour, alpha=0.6, linewidths=0, label=f"{reason} ({len(values)})")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("width", color=INK)
    axes.set_ylabel("height", color=INK)
    legend(axes)
    return figure


def draw_cameras(scene: "SceneRecord") -> "Figure":
    """The cameras and points of a batch's largest model from above and from the side, in its own units.

    An arrow points the way a camera looks. Up is where the images' upper borders are on average, and the cameras
    look ahead. Points far away from nearly all others are cut off. A batch without cameras has a line instead.
    """
    figure = new_figure(8.4, 4.0)
    cameras = [camera for camera in scene.cameras if camera.model == 0]
    if not cameras:
        figure.text(0.5, 0.5, f"{short(scene.batch)}: no cameras ({scene.failure})", ha="center", wrap=True)
        return figure
    right, ahead, up = axes_of(cameras)
    centres = np.array([camera.centre for camera in cameras])
    looks = np.array([camera.forward for camera in cameras])
    cloud = np.array(scene.cloud).reshape(-1, 3)
    arrow = 0.12 * (np.ptp(centres, axis=0).max() or 1.0)
    sides = (("above", right, ahead), ("the side", ahead, up))
    for panel, (name, across, upward) in zip(figure.subplots(1, 2), sides, strict=True):
        plain(panel, f"{short(scene.batch)}: {len(cameras)} cameras from {name}")
        x, y = centres @ across, centres @ upward
        near = _near(cloud @ across) & _near(cloud @ upward)
        panel.scatter(cloud[near] @ across, cloud[near] @ upward, s=2, color=DROPPED, linewidths=0)
        panel.quiver(
            *(x, y, arrow * looks @ across, arrow * looks @ upward),
            **{"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "color": CLUSTERS[3]},
        )
        panel.scatter(x, y, s=14, color=OUTLIER, linewidths=0, zorder=3)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.1)
    return figure


def axes_of(cameras: "Sequence[CameraRecord]") -> NDArray[np.float64]:
    """(3, 3), rows right, ahead and up of a scene as :func:`draw_cameras` shows it, in its own units."""
    down = np.mean([camera.down for camera in cameras], axis=0)
    forward = np.mean([camera.forward for camera in cameras], axis=0)
    up = -down / np.linalg.norm(down)
    ahead = forward - forward @ up * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def _near(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which values are not much farther out than nearly all of them."""
    low, high = np.percentile(values, (3, 97)) if len(values) else (0.0, 0.0)
    near: NDArray[np.bool_] = np.abs(values - (low + high) / 2) <= 0.7 * (high - low)
    return near


def _time_unit(seconds: float) -> tuple[float, str]:
    return next((pair for pair in ((3600, "hours"), (60, "minutes")) if seconds > 3 * pair[0]), (1, "seconds"))
