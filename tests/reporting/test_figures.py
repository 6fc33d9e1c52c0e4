"""Figures of a pair and of a scene: points, lines and cameras are where they should be."""

import cv2
import numpy as np
import pytest
import tour_figures as figures

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Estimate, ModelKind
from mkpc_kaggle.pipeline.drawing import draw_strip
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.reporting.figures import encode
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

SIZE0 = Size(120, 80)
SIZE1 = Size(60, 90)
UNITS = (
    Unit(1, "sift", 100),
    Unit(2, "sift", 100),
)
REGIONS = (
    CriticalRegion(Box(20, 10, 60, 30), RegionReason.CROPPED, 1, 1),
    CriticalRegion(Box.whole(SIZE1), RegionReason.NO_CLUSTER),
)


def gray(size, level):
    pixels = np.full((size.height, size.width, 3), level, np.uint8)
    return Image.of_array(pixels)


def some(n):
    """n matches in a corner of both images."""
    # Within the critical region of the first image
    rng = np.random.default_rng(n)
    points = rng.uniform(21, 29, (n, 2))
    return Matches(points, points, np.ones(n))


def test_points_of_stage_2_are_drawn_where_they_are_on_the_crop():
    first, second = UNITS
    results = (UnitResult(first, some(0)), UnitResult(second, some(20)))
    estimate = Estimate(ModelKind.F, FALLBACK_FUNDAMENTAL, np.ones(20, bool))
    match = PairMatch(results, REGIONS, estimate)
    images = (gray(SIZE0, 90), gray(SIZE1, 90))
    left, right = figures.draw_stage(images, match, 2).axes
    # The first view is the crop, the second one the whole image.
    assert left.images[0].get_array().shape[:2] == (20, 40)
    xy = np.concatenate([dots.get_offsets() for dots in left.collections])
    np.testing.assert_allclose(xy, some(20).points0 - (20, 10))
    assert right.images[0].get_array().shape[:2] == (90, 60)


def test_cameras_are_seen_from_above_and_from_the_side_with_the_points_before_them():
    """Two cameras two units apart look along the world's x axis, its z axis is up; a wall is ten
    units ahead.
    """
    # Rows: right, down, and ahead in the world
    R = np.array(
        [
            [0.0, -1, 0],
            [0, 0, -1],
            [1, 0, 0],
        ]
    )
    image = BatchImage("a.png", "a", Size(80, 60))
    placed = []
    for y in (0.0, 2.0):
        camera = Camera(np.eye(3), R, -R @ (0.0, y, 1.0))
        placed.append(RegisteredImage(image, camera, 9))
    wall = np.array([(10.0, y, z) for y in range(5) for z in range(8)])
    model = SfmModel(tuple(placed), wall, 0.5)
    above, side = figures.draw_model(model).axes
    cloud, _, centres = above.collections
    assert extent(centres) == [2, 0]
    assert extent(cloud) == [4, 0], "from above a wall is a line"
    assert (cloud.get_offsets()[:, 1] == 10).all()
    cloud, _, centres = side.collections
    assert extent(centres) == [0, 0], "one behind the other"
    assert extent(cloud) == [0, 7]
    assert cloud.get_offsets()[:, 1].max() == 7, "up is up"


def extent(dots):
    """The width and height of drawn points, in units of the axes."""
    return np.ptp(dots.get_offsets(), axis=0).tolist()


def test_a_strip_shows_both_images_upright_at_one_height_with_matches_where_they_are():
    # 100 wide in its file, and 200 when it is upright
    lying = gray(Size(100, 200), 250).turned(1)
    square = gray(Size(300, 300), 5)
    point0 = np.array([[89.5, 9.5]])
    point1 = np.array([[149.5, 149.5]])
    result = UnitResult(UNITS[0], Matches(point0, point1, np.ones(1)))
    found = Estimate(ModelKind.F, np.eye(3), np.array([True]))
    figure = draw_strip((lying, square), PairMatch((result,), None, found))
    jpeg = np.frombuffer(encode(figure, "jpeg"), np.uint8)
    drawn = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    # Older versions of matplotlib round down
    assert drawn.shape[:2] == pytest.approx((480, 960 + 480), abs=1)
    assert drawn[400, 100].min() > 200
    assert drawn[400, 1400].max() < 50
    drawn_points = [dots.get_offsets() for dots in figure.axes[0].collections]
    (ends,) = (points for points in drawn_points if len(points) > 1)
    np.testing.assert_allclose(ends, [[0.1, 0.1], [2 + 0.5, 0.5]])


def test_a_strip_is_drawn_once(monkeypatch):
    image = gray(Size(60, 40), 100)
    figure = draw_strip((image, image), PairMatch())
    drawn = []
    draw = figure.draw
    monkeypatch.setattr(figure, "draw", lambda renderer: drawn.append(draw(renderer)))
    encode(figure, "jpeg")
    assert len(drawn) == 1
