"""Figures for the steps of the method, on one pair."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from score_figures import COLOURS, DROPPED, plain_axes, short

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Points
from mkpc_kaggle.geometry.critical_region import (
    Clusters,
    CriticalRegion,
    MkpcConfig,
    expand_box,
)
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import PoseError
from mkpc_kaggle.geometry.robust import Estimate
from mkpc_kaggle.pipeline.drawing import INLIER, OUTLIER, REGION, new_figure, sample
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.models import Reconstruction, SfmModel, models_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Images = tuple[Image, Image]
WIDTH = 10.0  # inches, across a notebook
# RootSIFT with few keypoints and small views
TELEPHOTO = Path(__file__).resolve().parents[1] / "benchmarks" / "telephoto.toml"
MAX_INLIERS, MAX_OUTLIERS = 150, 30  # number of lines drawn
_PAPER = {"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.8, "linewidth": 0}


def read_true_pair(directory: Path, pair: str) -> tuple[TrainScene, TruePair]:
    """Return the pair ``SCENE;IMAGE-IMAGE`` of a train side, with any covisibility, and its scene.

    Raises :class:`UserError` for an unknown pair, and the errors of :func:`read_train_side`.
    """
    (scene,) = read_train_side(
        directory, scenes=[pair.partition(";")[0]], min_covisibility=0.0
    )
    known = {true.pair.id: true for true in scene.pairs}
    if pair not in known:
        raise UserError(
            f"{directory}: unknown pair {pair!r}; known: {', '.join(list(known)[:3])}, ..."
        )
    return scene, known[pair]


def draw_images(images: Images) -> "Figure":
    """Draw the two photographs."""
    figure, row = side_by_side(images)
    for number, (axes, image) in enumerate(zip(row, images, strict=True)):
        _title(axes, f"image {number}: {image.size.width} x {image.size.height} pixels")
    return figure


def draw_stage(images: Images, match: PairMatch, stage: int) -> "Figure":
    """Draw the matches of one stage, coloured by inlier; stage 2 on the crops."""
    mask = match.in_stage(stage)
    inliers = match.estimate.inliers[mask]
    regions = match.regions if stage == 2 else None
    boxes = (
        [region.box for region in regions]
        if regions
        else [Box.whole(image.size) for image in images]
    )
    figure, row = side_by_side(
        [_cut(image, box) for image, box in zip(images, boxes, strict=True)]
    )
    # The figure shows the crop alone, so the points move by its offset.
    shift0, shift1 = (np.array([box.left, box.top], np.float32) for box in boxes)
    found = match.matches[mask]
    drawn = connect(
        row, Matches(found.points0 - shift0, found.points1 - shift1, found.scores), inliers
    )
    what = (
        "on the crops"
        if any(region.reason == "cropped" for region in regions or ())
        else "on the whole images"
    )
    counts = f"{len(found)} matches, {np.count_nonzero(inliers)} inliers"
    _title(row[0], f"stage {stage}, {what}: {counts}; {drawn}")
    return figure


def draw_clusters(
    images: Images, points: tuple[Points, Points], clusters: tuple[Clusters, Clusters]
) -> "Figure":
    """Draw all clusters of each image, one colour each, with their sizes; noise as grey crosses."""
    figure, row = side_by_side(images, title_lines=2)
    for number, (axes, xy, found) in enumerate(zip(row, points, clusters, strict=True)):
        noise = xy[found.labels < 0]
        _crosses(axes, noise, DROPPED)
        for rank, label in enumerate(_by_size(found)):
            _dots(axes, xy[found.labels == label], COLOURS[rank % len(COLOURS)])
        for label in _by_size(found):
            _tag(axes, xy[found.labels == label], str(found.sizes[label]))
        counts = f"numbers: points of each cluster; {len(noise)} points are noise"
        _title(axes, f"image {number}, clusters found: {len(found.sizes)}\n{counts}")
    return figure


def draw_sizes(clusters: tuple[Clusters, Clusters], config: MkpcConfig) -> "Figure":
    """Draw bars of the cluster sizes of each image, and the size below which clusters are dropped."""
    figure = new_figure(WIDTH, 3.6)
    for number, (axes, found) in enumerate(zip(figure.subplots(1, 2), clusters, strict=True)):
        _size_bars(axes, found, config)
        kept = f"image {number}: {len(found.kept)} of {len(found.sizes)} clusters kept"
        plain_axes(axes, kept + _limit(found, config))
    return figure


def _size_bars(axes: "Axes", clusters: Clusters, config: MkpcConfig) -> None:
    sizes = clusters.sizes[_by_size(clusters)]
    kept = len(clusters.kept)
    axes.set_xlabel("clusters, by size; green: kept; orange and hatched: dropped")
    axes.set_ylabel("points")
    if not len(sizes):
        axes.set(xticks=[], yticks=[])
        return
    ranks = np.arange(1, len(sizes) + 1)
    for part, colour, hatch in (
        (slice(kept), INLIER, ""),
        (slice(kept, None), OUTLIER, "//"),
    ):
        bars = axes.bar(
            ranks[part], sizes[part], color=colour, hatch=hatch, edgecolor="white", width=0.7
        )
        # More than ten labels of two lines would overlap.
        shares = [f"\n{size / sizes[0]:.3f}" if len(sizes) <= 10 else "" for size in sizes]
        labels = [
            f"{size}{share}" for size, share in zip(sizes[part], shares[part], strict=True)
        ]
        axes.bar_label(bars, labels, padding=3, fontsize=9, bbox=_PAPER)
    axes.axhline(config.share * sizes[0], color="black", linewidth=1.2, linestyle="--")
    # A logarithmic scale, because the largest cluster may have a hundred times the points of a
    # dropped one.
    axes.set(yscale="log", ylim=(1, 8 * sizes[0]), xticks=ranks)


def _limit(clusters: Clusters, config: MkpcConfig) -> str:
    if not len(clusters.sizes):
        return ""
    return f"\ndashed: {config.share:g} of the largest cluster, {config.share * clusters.sizes.max():.1f} points"


def draw_boxes(
    images: Images,
    points: tuple[Points, Points],
    clusters: tuple[Clusters, Clusters],
    config: MkpcConfig,
) -> "Figure":
    """Draw the bounding box of the kept clusters, without and with expansion; dropped points as
    crosses.
    """
    figure, row = side_by_side(images, title_lines=2)
    for number, (axes, image, xy, found) in enumerate(
        zip(row, images, points, clusters, strict=True)
    ):
        kept = xy[found.in_kept]
        _crosses(axes, xy[~found.in_kept], OUTLIER)
        _dots(axes, kept, INLIER)
        title = f"image {number}: no kept points, so no box"
        if len(kept):
            tight = expand_box(kept, image.size, 1, 1)
            wide = expand_box(kept, image.size, config.expand_x, config.expand_y)
            add_box(axes, wide)
            add_box(axes, tight, edgecolor="white", linestyle="--", linewidth=1.5)
            title = f"image {number}, dashed: box of the kept points, {tight.size.width} x {tight.size.height}\n"
            title += f"yellow: expanded box, {wide.size.width} x {wide.size.height}"
        _title(axes, title)
    return figure


def draw_views(
    images: Images, regions: tuple[CriticalRegion, CriticalRegion], unit: Unit
) -> "Figure":
    """Draw a unit's view of each whole image and of its critical region, with their scales."""
    pictures: list[Image] = []
    titles: list[str] = []
    for number, (image, region) in enumerate(zip(images, regions, strict=True)):
        # A region that is not cropped has a reason, such as too few points.
        crop = "crop" if region.reason == "cropped" else f"crop ({region.reason})"
        for what, box in (("whole", Box.whole(image.size)), (crop, region.box)):
            view = unit.view(box, 1)
            pictures.append(Image("", view.render(image.pixels)))
            titles.append(f"image {number}, {what}\nscaled by {view.scale[0]:.2f}")
    figure, row = side_by_side(pictures, title_lines=2)
    for axes, title in zip(row, titles, strict=True):
        _title(axes, title)
    return figure


def draw_both(images: Images, match: PairMatch) -> "Figure":
    """Draw the points of both stages on the whole images: inliers in the colour of their stage,
    outliers grey.
    """
    figure, row = side_by_side(images, title_lines=2)
    inliers = match.estimate.inliers
    for axes, points in zip(row, (match.matches.points0, match.matches.points1), strict=True):
        _crosses(axes, points[~inliers], DROPPED)
        for stage, marker in ((1, "o"), (2, "^")):
            xy = points[match.in_stage(stage) & inliers]
            axes.scatter(
                xy[:, 0], xy[:, 1], s=9, c=COLOURS[stage - 1], marker=marker, linewidths=0
            )
    counts = [
        f"{what}: stage {stage}, {np.count_nonzero(match.in_stage(stage))} points, "
        f"{np.count_nonzero(match.in_stage(stage) & inliers)} inliers"
        for stage, what in ((1, "dots"), (2, "triangles"))
    ]
    _title(row[0], "\n".join(counts))
    total = f"together: {len(match.matches)} points, {match.estimate.inlier_count} inliers"
    _title(row[1], f"{total}\ncrosses: outliers")
    return figure


def draw_epipolar(
    images: Images,
    matches: Matches,
    fundamentals: Mapping[str, Matrix3],
    truth: Matrix3 | None = None,
    count: int = 6,
) -> "Figure":
    """Draw ``count`` points of image 0 and their epipolar lines in image 1 by each F; the true
    lines are dashed.

    The points are matches, far from each other. Image 1 also shows their matched points.
    """
    figure, row = side_by_side([images[0], *[images[1]] * len(fundamentals)], title_lines=2)
    chosen = matches[_far_apart(matches.points0, count)]
    _numbered(row[0], chosen.points0)
    _title(row[0], f"image 0: {len(chosen)} matched points")
    for axes, (name, F) in zip(row[1:], fundamentals.items(), strict=True):
        for index, point in enumerate(chosen.points0):
            _line(axes, F, point, color=COLOURS[index % len(COLOURS)], linewidth=2)
            if truth is not None:
                _line(axes, truth, point, color="white", linewidth=1.2, linestyle=(0, (4, 4)))
        _numbered(axes, chosen.points1)
        size = images[1].size
        axes.set(xlim=(-0.5, size.width - 0.5), ylim=(size.height - 0.5, -0.5))
        known = "\nwhite, dashed: the true lines" if truth is not None else ""
        _title(axes, f"image 1: lines by {name}{known}")
    return figure


def draw_plane(
    images: Images, matches: Matches, homography: Estimate, threshold: float
) -> "Figure":
    """Draw the inliers of an F: on the plane of a homography, and off it."""
    figure, row = side_by_side(images, title_lines=2)
    for axes, points in zip(row, (matches.points0, matches.points1), strict=True):
        _dots(axes, points[homography.inliers], COLOURS[0])
        _crosses(axes, points[~homography.inliers], OUTLIER)
    explained = f"{homography.inlier_count} of {len(matches)} inliers of F"
    _title(row[0], f"blue: {explained}\nwithin {threshold:g} pixels of one plane")
    _title(row[1], "orange crosses: off the plane")
    return figure


def draw_pose_errors(errors: Mapping[str, PoseError]) -> "Figure":
    """Draw bars of the pose errors of each F, in degrees; the errors of a failure are infinite."""
    figure = new_figure(WIDTH, 1.0 + 0.4 * len(errors))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, kind, title in zip(
        panels,
        ("rotation", "translation_angle"),
        ("rotation", "direction of translation"),
        strict=True,
    ):
        plain_axes(axes, f"error of the {title} (degrees)")
        angles = np.array([getattr(error, kind) for error in errors.values()])
        known = np.isfinite(angles)
        names = [short(name, 40) for name in errors]
        bars = axes.barh(
            names, np.where(known, angles, 0), color=list(COLOURS[: len(names)]), height=0.6
        )
        # Significant digits: the errors of a pair may be thousandths of a degree.
        labels = [
            f"{angle:.3g}" if ok else "no F" for angle, ok in zip(angles, known, strict=True)
        ]
        axes.bar_label(bars, labels, padding=3)
        axes.margins(x=0.15)
        # With more ticks, the numbers of both panels would touch.
        axes.locator_params(axis="x", nbins=5)
    panels[0].invert_yaxis()
    return figure


def side_by_side(
    images: Sequence[Image], title_lines: int = 1
) -> "tuple[Figure, Sequence[Axes]]":
    """Show pictures in a row at one height, with room for titles of ``title_lines`` lines."""
    aspects = [image.size.width / image.size.height for image in images]
    height = min((WIDTH - 0.1 * (len(images) + 1)) / sum(aspects), 5.0)
    figure = new_figure(WIDTH, height + 0.3 + 0.17 * title_lines)
    figure.set_layout_engine("compressed")
    row = figure.subplots(1, len(images), width_ratios=aspects, squeeze=False)[0]
    for axes, image in zip(row, images, strict=True):
        axes.imshow(image.pixels)
        axes.set(xticks=[], yticks=[])
    return figure, row


def connect(axes: "Sequence[Axes]", matches: Matches, inliers: NDArray[np.bool_]) -> str:
    """Draw a sample of the matches from one picture to the other. Return a description of the
    sample.
    """
    from matplotlib.patches import ConnectionPatch

    outliers_drawn = sample(~inliers, MAX_OUTLIERS)
    inliers_drawn = sample(inliers, MAX_INLIERS)
    # Inliers last, so that they are on top.
    for indices, colour, width in (
        (outliers_drawn, OUTLIER, 0.5),
        (inliers_drawn, INLIER, 0.7),
    ):
        for panel, points in zip(axes, (matches.points0, matches.points1), strict=True):
            panel.scatter(points[indices, 0], points[indices, 1], s=6, c=colour, linewidths=0)
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
    return f"{len(inliers_drawn)} inliers (green) and {len(outliers_drawn)} outliers (orange) drawn"


def add_box(axes: "Axes", box: Box, **style: Any) -> None:
    """Draw the outline of a box of image pixels; ``style`` is matplotlib's."""
    from matplotlib.patches import Rectangle

    style = {"edgecolor": REGION, "linewidth": 2.5, **style}
    corner = box.left - 0.5, box.top - 0.5
    axes.add_patch(Rectangle(corner, box.size.width, box.size.height, fill=False, **style))


def _title(axes: "Axes", text: str) -> None:
    axes.set_title(text, loc="left", fontsize=10)


def _cut(image: Image, box: Box) -> Image:
    return Image(image.name, image.pixels[box.top : box.bottom, box.left : box.right])


def _by_size(clusters: Clusters) -> NDArray[np.intp]:
    """Return the labels, largest cluster first: the order in which MKPC keeps them."""
    return np.argsort(-clusters.sizes, kind="stable")


def _dots(axes: "Axes", points: Points, colour: str) -> None:
    axes.scatter(points[:, 0], points[:, 1], s=9, c=colour, linewidths=0)


def _crosses(axes: "Axes", points: Points, colour: str) -> None:
    axes.scatter(points[:, 0], points[:, 1], s=12, c=colour, marker="x", linewidths=0.8)


def _tag(axes: "Axes", points: Points, text: str) -> None:
    """Write a number above a group of points."""
    x, y = points[:, 0].mean(), points[:, 1].min()
    axes.text(x, y, text, fontsize=8, ha="center", va="bottom", bbox=_PAPER)


def _numbered(axes: "Axes", points: Points) -> None:
    for index, (x, y) in enumerate(points):
        colour = COLOURS[index % len(COLOURS)]
        axes.scatter(x, y, s=130, c=colour, edgecolors="white", linewidths=1, zorder=3)
        axes.text(
            x,
            y,
            str(index + 1),
            color="white",
            fontsize=8,
            ha="center",
            va="center_baseline",
            zorder=4,
        )


def _line(axes: "Axes", F: Matrix3, point: Points, **style: Any) -> None:
    """Draw the epipolar line of a point of image 0 on image 1: a x + b y + c = 0 with (a, b, c) = F
    x.
    """
    a, b, c = F @ np.append(point.astype(np.float64), 1)
    normal = a * a + b * b
    if normal > 0:
        # The point of the line nearest to the origin; the line may be vertical.
        foot = np.array([-a * c / normal, -b * c / normal])
        axes.axline(tuple(foot), tuple(foot + (b, -a) / np.sqrt(normal)), **style)


def _far_apart(points: Points, count: int) -> NDArray[np.intp]:
    """Return indices of distant points: each next point is the farthest from the points before it."""
    if not len(points):
        return np.zeros(0, np.intp)
    chosen = [int(np.argmin(points.sum(axis=1)))]
    distances = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen, np.intp)


def draw_scene(reconstructions: Sequence[Reconstruction]) -> "Figure":
    """Draw the cameras and points of the largest model of a batch, or the reason for no model."""
    models = models_of(reconstructions)
    if models:
        return draw_model(models[0])
    reason = "; ".join(found.failure for found in reconstructions) or "no connected images"
    figure = new_figure(8.4, 4.0)
    figure.text(0.5, 0.5, f"no cameras: {reason}", ha="center", wrap=True)
    return figure


def draw_model(model: SfmModel) -> "Figure":
    """Draw a model's cameras and points, in model units, from above and the side.

    An arrow shows the viewing direction of a camera. Up is the images' mean up direction, and ahead
    is the mean viewing direction. Points far from nearly all others are left out.
    """
    figure = new_figure(8.4, 4.0)
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


def _draw_projected(
    panel: "Axes", name: str, model: SfmModel, axes: NDArray[np.float64]
) -> None:
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
