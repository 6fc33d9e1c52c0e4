"""Cameras and points of a model in 3D, as a figure of plotly."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pandas import DataFrame

FRUSTUM_SHARE = 0.4  # depth of a frustum over the distance to the nearest camera
MIN_FRUSTUM = 0.02  # in extents of the view
MAX_FRUSTUM = 0.08
REACH = 1.5  # points are drawn up to here, in ranges of nearly all points from their middle
# The centre and the corners of the picture, as one line of plotly
OUTLINE = [0, 1, 2, 0, 3, 4, 0, 2, 3, 0, 4, 1]
POINT = {"size": 1.5, "color": "#777777"}
CENTRE = {"size": 3, "color": "#D55E00"}
LINE = {"color": "#0072B2"}
# From behind the mean camera, and a little above
EYE = {"x": 0.0, "y": -1.5, "z": 0.6}
HIDDEN = {"visible": False}


def view(cameras: "DataFrame", points: NDArray[np.float64]) -> Any:
    """Return a figure with the cameras, rows of ``results(DIR).cameras``, and points (P, 3).

    Raises ``ImportError`` without plotly.
    """
    from plotly.graph_objects import Figure, Scatter3d

    axes = upright(np.stack([*cameras["R"]]))
    centres = [-R.T @ t for R, t in zip(cameras["R"], cameras["t"], strict=True)]
    shown = near(points)
    extent = float(np.ptp(np.vstack([*centres, *shown]), axis=0).max())
    depth = FRUSTUM_SHARE * spacing(np.stack(centres))
    # Frusta neither hide all else nor vanish.
    depth = min(max(depth, MIN_FRUSTUM * extent), MAX_FRUSTUM * extent) or 1.0
    outlines = []
    for row, centre in zip(cameras.to_dict("records"), centres, strict=True):
        rays = np.linalg.inv(row["K"]) @ corners_of(row["width"], row["height"])
        corners = centre + depth * rays.T @ row["R"]
        frustum = np.vstack([centre, corners])
        outlines.append(frustum[OUTLINE])
        # A row of NaN ends the line of a camera.
        outlines.append(np.full((1, 3), np.nan))

    def scatter(values: NDArray[np.float64], **style: Any) -> Any:
        x, y, z = axes @ values.T
        return Scatter3d(x=x, y=y, z=z, showlegend=False, **style)

    cloud = scatter(
        shown,
        mode="markers",
        marker=POINT,
        hoverinfo="skip",
    )
    frusta = scatter(
        np.vstack(outlines),
        mode="lines",
        line=LINE,
        hoverinfo="skip",
    )
    named = scatter(
        np.stack(centres),
        mode="markers",
        marker=CENTRE,
        text=cameras["image"].tolist(),
        hovertemplate="%{text}<extra></extra>",
    )
    figure = Figure([cloud, frusta, named])
    figure.update_layout(
        height=560,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        scene={
            "aspectmode": "data",
            "camera": {"eye": EYE},
            "xaxis": HIDDEN,
            "yaxis": HIDDEN,
            "zaxis": HIDDEN,
        },
    )
    return figure


def upright(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes (3, 3) right, ahead and up of the mean of rotations (C, 3, 3)."""
    # A model's axes are arbitrary, but photographs are mostly taken upright.
    mean = rotations.mean(axis=0)
    # Cameras of all orientations have no common vertical.
    if np.linalg.norm(mean[1]) < 1e-6:
        mean = rotations[0]
    down = mean[1] / np.linalg.norm(mean[1])
    ahead = mean[2] - mean[2] @ down * down
    # Cameras around an object look in all directions.
    if np.linalg.norm(ahead) < 0.1:
        first = rotations[0, 2]
        ahead = first - first @ down * down
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    right = np.cross(down, ahead)
    return np.stack([right, ahead, -down])


def corners_of(width: int, height: int) -> NDArray[np.float64]:
    """Return the homogeneous corners (3, 4) of a picture, in pixels."""
    right = width - 0.5
    bottom = height - 0.5
    return np.array(
        [
            [-0.5, right, right, -0.5],
            [-0.5, -0.5, bottom, bottom],
            [1, 1, 1, 1],
        ]
    )


def spacing(centres: NDArray[np.float64]) -> float:
    """Return the median distance of a camera to the nearest other one; 0 for a single camera."""
    if len(centres) < 2:
        return 0.0
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = distances.min(axis=1)
    return float(np.median(nearest))


def near(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points that lie near nearly all others: a few wrong ones would shrink the view."""
    if not len(points):
        return points
    low, high = np.percentile(points, (3, 97), axis=0)
    middle = (low + high) / 2
    distances: NDArray[np.float64] = np.abs(points - middle)
    is_near: NDArray[np.bool_] = (distances <= REACH * (high - low)).all(axis=1)
    return points[is_near]
