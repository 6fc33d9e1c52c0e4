"""Cameras and points of a model in 3D, as a figure of plotly."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pandas import DataFrame

FRUSTUM_SHARE = 0.4  # depth of a frustum over the distance to the nearest camera
REACH = 1.5  # points are drawn up to here, in ranges of nearly all points from their middle
# The centre and the corners of the picture, as one line of plotly
OUTLINE = [0, 1, 2, 0, 3, 4, 0, 2, 3, 0, 4, 1]


def view(cameras: "DataFrame", points: NDArray[np.float64]) -> Any:
    """Return a figure with the cameras, rows of ``results(DIR).cameras``, and points (P, 3).

    Raises ``ImportError`` without plotly.
    """
    from plotly.graph_objects import Figure, Scatter3d

    axes = upright(np.stack([*cameras["R"]]))
    centres = np.stack([-R.T @ t for R, t in zip(cameras["R"], cameras["t"], strict=True)])
    depth = FRUSTUM_SHARE * spacing(centres)
    outlines = []
    for row, centre in zip(cameras.to_dict("records"), centres, strict=True):
        corners = np.linalg.inv(row["K"]) @ corners_of(row["width"], row["height"])
        frustum = np.vstack([centre, centre + depth * corners.T @ row["R"]])
        # A row of NaN ends the line of a camera.
        outlines += [frustum[OUTLINE], np.full((1, 3), np.nan)]

    def scatter(values: NDArray[np.float64], **style: Any) -> Any:
        x, y, z = (values @ axes.T).T
        return Scatter3d(x=x, y=y, z=z, showlegend=False, **style)

    dots = {"size": 1.5, "color": "#777777"}
    figure = Figure(
        [
            scatter(near(points), mode="markers", marker=dots, hoverinfo="skip"),
            scatter(np.vstack(outlines), mode="lines", line_color="#0072B2", hoverinfo="skip"),
            scatter(
                centres,
                mode="markers",
                marker={"size": 3, "color": "#D55E00"},
                text=cameras["image"].tolist(),
                hovertemplate="%{text}<extra></extra>",
            ),
        ]
    )
    hidden = {f"{axis}axis_visible": False for axis in "xyz"}
    # From behind the mean camera, and a little above
    eye = {"x": 0.0, "y": -1.5, "z": 0.6}
    figure.update_layout(
        scene={"aspectmode": "data", "camera_eye": eye, **hidden},
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        height=560,
    )
    return figure


def upright(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes (3, 3) right, ahead and up of the mean of rotations (C, 3, 3)."""
    # A model's axes are arbitrary, but photographs are mostly taken upright.
    _, down, ahead = rotations.mean(axis=0)
    if np.linalg.norm(down) < 1e-6:  # cameras of all orientations have no common vertical
        down = rotations[0, 1]
    down = down / np.linalg.norm(down)
    ahead = ahead - ahead @ down * down
    if np.linalg.norm(ahead) < 0.1:  # cameras around an object look in all directions
        ahead = rotations[0, 2] - rotations[0, 2] @ down * down
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return np.stack([np.cross(down, ahead), ahead, -down])


def corners_of(width: int, height: int) -> NDArray[np.float64]:
    """Return the homogeneous corners (3, 4) of a picture, in pixels."""
    right = width - 0.5
    bottom = height - 0.5
    return np.array([[-0.5, right, right, -0.5], [-0.5, -0.5, bottom, bottom], [1, 1, 1, 1]])


def spacing(centres: NDArray[np.float64]) -> float:
    """Return the median distance of a camera to the nearest other one; 1 for a single camera."""
    if len(centres) < 2:
        return 1.0
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(np.median(distances.min(axis=1))) or 1.0


def near(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points that lie near nearly all others: a few wrong ones would shrink the view."""
    if not len(points):
        return points
    low, high = np.percentile(points, (3, 97), axis=0)
    is_near: NDArray[np.bool_] = np.abs(points - (low + high) / 2) <= REACH * (high - low)
    return points[is_near.all(axis=1)]
