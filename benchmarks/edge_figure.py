"""The verified edges of a scene, drawn around it: which are wrong by truth.

python -m benchmarks.edge_figure --train-dir DIR --journals DIR... --scene NAME --out FILE [--photographs]

A panel shows the true camera centres from above, in the plane of the two main axes, for the tracks of all
units and of each alone. Right edges are grey, wrong ones red; wide ones have many inliers. With
``--photographs``, the wrong edge with the most inliers is below, with its matches.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.candidate_facts import ALL, VerifiedEdge, verified_edges
from benchmarks.candidates import draws_of

RIGHT, WRONG = "0.7", "#c0392b"
MAX_WIDTH = 6.0  # points, of the edge with the most inliers
MAX_DRAWN = 40  # matches


def plane_of(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return camera centres (N, 3) in the plane of their two main axes, (N, 2)."""
    centred = centres - centres.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return np.asarray(centred @ axes[:2].T)


def draw_edges(
    axes: Axes, edges: Sequence[VerifiedEdge], places: dict[str, NDArray[np.float64]]
) -> None:
    most = max((len(edge.inliers) for edge in edges), default=1)
    # The wrong ones last, above the others
    for edge in sorted(edges, key=lambda edge: edge.is_wrong):
        line = np.array([places[image.name] for image in edge.images])
        width = max(1.0, MAX_WIDTH * np.sqrt(len(edge.inliers) / most))
        axes.plot(*line.T, color=WRONG if edge.is_wrong else RIGHT, linewidth=width)
    for name, place in places.items():
        axes.plot(*place, "o", color="black", markersize=4)
        axes.annotate(Path(name).stem[-4:], place, (3, 3), textcoords="offset points", fontsize=7)
    axes.set_aspect("equal")
    axes.set_axis_off()


def draw_matches(axes: Axes, edge: VerifiedEdge, images: Path) -> None:
    pictures = [
        cv2.cvtColor(cv2.imread(str(images / each.name)), cv2.COLOR_BGR2RGB) for each in edge.images
    ]
    shift = np.array([pictures[0].shape[1], 0])
    axes.imshow(np.hstack(pictures))
    for start, end in zip(
        edge.inliers.points0[:MAX_DRAWN], edge.inliers.points1[:MAX_DRAWN], strict=True
    ):
        axes.plot(
            *np.array([start, end + shift]).T, color=WRONG, linewidth=0.7, marker=".", markersize=3
        )
    names = " and ".join(Path(each.name).stem for each in edge.images)
    axes.set_title(
        f"{names}: {len(edge.inliers)} inliers, {edge.share_right:.0%} of them right", fontsize=9
    )
    axes.set_axis_off()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, nargs="+", required=True)
    parser.add_argument("--journals", type=Path, nargs="+", required=True)
    parser.add_argument("--scene", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--photographs", action="store_true")
    arguments = parser.parse_args()
    # The draw of all images
    options = {
        "scenes": [arguments.scene],
        "images": [0],
        "supports": [],
        "true_edges": False,
        "held_out": False,
    }
    (draw,) = draws_of(argparse.Namespace(**vars(arguments), **options, seeds=1))
    names = sorted({name for pair in draw.pairs for name in pair.names})
    centres = plane_of(np.array([draw.cameras[name].centre for name in names]))
    places = dict(zip(names, centres, strict=True))
    rows = 2 if arguments.photographs else 1
    figure = Figure(figsize=(12, 4.2 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, len(draw.candidates))
    wrong: list[VerifiedEdge] = []
    for column, candidate in enumerate(draw.candidates):
        edges = [*verified_edges(draw, candidate)]
        axes = figure.add_subplot(grid[0, column])
        draw_edges(axes, edges, places)
        found = [edge for edge in edges if edge.is_wrong]
        tracks = "all units" if candidate == ALL else candidate
        axes.set_title(f"{tracks}: {len(edges)} edges, {len(found)} wrong", fontsize=9)
        wrong += found
    if wrong and arguments.photographs:
        worst = max(wrong, key=lambda edge: len(edge.inliers))
        images = draw.scene.pairs[0].pair.images[0].parent
        draw_matches(figure.add_subplot(grid[1, :]), worst, images)
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    main()
