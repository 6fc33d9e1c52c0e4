"""Figures of a run: jobs over time, and the cameras of a scene."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.reporting.figures.style import COLOURS, DROPPED, OUTLIER, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mkpc_kaggle.engine.records import CameraRecord, SceneRecord

MAX_EMPTY = 4  # a time limit of more run lengths is not drawn: it would leave no room for the jobs


def draw_budget(ended: Mapping[str, Sequence[float]], limit: float | None) -> "Figure":
    """Draw the number of ended jobs over time, a colour for each phase. A flat segment is time without a result.

    ``ended`` has seconds since the start by phase, ``limit`` is the time limit in seconds.
    """
    figure = new_figure(6.5, 3.2)
    axes = plain(figure.subplots(), f"{sum(map(len, ended.values()))} jobs ended, over minutes since the start")
    below, latest = 0, 0.0
    for phase, times in ended.items():
        counts = below + 1 + np.arange(len(times))
        axes.step(np.asarray(times) / 60, counts, "o-", where="post", markersize=2.5, label=phase)
        below, latest = below + len(times), max(latest, *times)
    if limit is not None and limit < MAX_EMPTY * latest:
        axes.axvline(limit / 60, color="black", linewidth=1.2, label="time limit")
    axes.set(xlim=(0, None), ylim=(0, None), xlabel="minutes")
    if ended:
        axes.legend(fontsize=8, frameon=False)
    return figure


def draw_cameras(scene: "SceneRecord", number: int = 0) -> "Figure":
    """The cameras and points of a model of a batch, 0 the largest, from above and the side, in its own units.

    An arrow points the way a camera looks. Up is the mean direction of the images' upper borders, and the cameras
    look ahead. Points far away from nearly all others are cut off. A batch without cameras has a line instead.
    """
    figure = new_figure(8.4, 4.0)
    cameras = [camera for camera in scene.cameras if camera.model == number]
    if not cameras:
        figure.text(0.5, 0.5, f"no cameras: {scene.failure}", ha="center", wrap=True)
        return figure
    right, ahead, up = _axes_of(cameras)
    centres = np.array([camera.centre for camera in cameras])
    looks = np.array([camera.forward for camera in cameras])
    cloud = np.array(scene.clouds[number] if scene.clouds else ()).reshape(-1, 3)
    arrow = 0.12 * (np.ptp(centres, axis=0).max() or 1.0)
    sides = (("above", right, ahead), ("the side", ahead, up))
    for panel, (name, across, upward) in zip(figure.subplots(1, 2), sides, strict=True):
        plain(panel, f"{len(cameras)} cameras from {name}")
        x, y = centres @ across, centres @ upward
        near = _near(cloud @ across) & _near(cloud @ upward)
        panel.scatter(cloud[near] @ across, cloud[near] @ upward, s=2, color=DROPPED, linewidths=0)
        panel.quiver(
            *(x, y, arrow * looks @ across, arrow * looks @ upward),
            **{"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "color": COLOURS[0]},
        )
        panel.scatter(x, y, s=14, color=OUTLIER, linewidths=0, zorder=3)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.1)
    return figure


def _axes_of(cameras: "Sequence[CameraRecord]") -> NDArray[np.float64]:
    """(3, 3), rows right, ahead and up of a scene as :func:`draw_cameras` shows it, in its own units."""
    down = np.mean([camera.down for camera in cameras], axis=0)
    forward = np.mean([camera.forward for camera in cameras], axis=0)
    up = -down / np.linalg.norm(down)
    ahead = forward - forward @ up * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def _near(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the mask of values that are not far outside the range of nearly all values."""
    low, high = np.percentile(values, (3, 97)) if len(values) else (0.0, 0.0)
    near: NDArray[np.bool_] = np.abs(values - (low + high) / 2) <= 0.7 * (high - low)
    return near
