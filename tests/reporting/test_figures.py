"""Figures of a pair and of a scene: points, lines and cameras are where they should be."""

import cv2
import numpy as np
import pytest
import tour_figures as figures

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.engine.records import SceneRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Estimate, ModelKind
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.reporting.figures import draw_cameras, draw_strip, encode
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

SIZES = Size(120, 80), Size(60, 90)
IMAGES = tuple(
    Image.of_array(np.full((size.height, size.width, 3), 90, np.uint8)) for size in SIZES
)
UNITS = Unit(1, "sift", 100), Unit(2, "sift", 100)
REGIONS = (
    CriticalRegion(Box(20, 10, 60, 30), RegionReason.CROPPED, 1, 1),
    CriticalRegion(Box.whole(SIZES[1]), RegionReason.NO_CLUSTER),
)


def some(n):
    """n matches in a corner of both images."""
    # Within the critical region of the first image
    points = np.random.default_rng(n).uniform(21, 29, (n, 2))
    return Matches(points, points, np.ones(n))


def test_points_of_stage_2_are_drawn_where_they_are_on_the_crop():
    results = tuple(UnitResult(unit, some(n)) for unit, n in zip(UNITS, (0, 20), strict=True))
    match = PairMatch(
        results, REGIONS, Estimate(ModelKind.F, FALLBACK_FUNDAMENTAL, np.ones(20, bool))
    )
    left, right = figures.draw_stage(IMAGES, match, 2).axes
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
    R = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    cameras = [Camera(np.eye(3), R, -R @ (0.0, 2.0 * n, 1.0)) for n in (0, 1)]
    wall = np.array([(10.0, y, z) for y in range(5) for z in range(8)])
    images = tuple(
        RegisteredImage(BatchImage("a.png", "a", Size(80, 60)), camera, 9) for camera in cameras
    )
    above, side = draw_cameras(SceneRecord("batch", models=(SfmModel(images, wall, 0.5),))).axes
    (cloud, _, centres), (seen, _, points) = ([*panel.collections] for panel in (above, side))
    assert np.ptp(centres.get_offsets(), axis=0).tolist() == [2, 0]
    assert np.ptp(cloud.get_offsets(), axis=0).tolist() == [4, 0], "from above a wall is a line"
    assert (cloud.get_offsets()[:, 1] == 10).all()
    assert np.ptp(points.get_offsets(), axis=0).tolist() == [0, 0], "one behind the other"
    assert np.ptp(seen.get_offsets(), axis=0).tolist() == [0, 7]
    assert seen.get_offsets()[:, 1].max() == 7, "up is up"


def test_a_strip_shows_both_images_upright_at_one_height_with_matches_where_they_are():
    # 100 wide in its file, and 200 when it is upright
    lying = Image.of_array(np.full((200, 100, 3), 250, np.uint8)).turned(1)
    square = Image.of_array(np.full((300, 300, 3), 5, np.uint8))
    matches = Matches(np.array([[89.5, 9.5]]), np.array([[149.5, 149.5]]), np.ones(1))
    found = Estimate(ModelKind.F, np.eye(3), np.array([True]))
    figure = draw_strip((lying, square), PairMatch((UnitResult(UNITS[0], matches),), None, found))
    drawn = cv2.imdecode(np.frombuffer(encode(figure, "jpeg"), np.uint8), cv2.IMREAD_COLOR)
    # Older versions of matplotlib round down
    assert drawn.shape[:2] == pytest.approx((480, 960 + 480), abs=1)
    assert drawn[400, 100].min() > 200
    assert drawn[400, 1400].max() < 50
    ends = [
        dots.get_offsets() for dots in figure.axes[0].collections if len(dots.get_offsets()) > 1
    ]
    np.testing.assert_allclose(np.concatenate(ends), [[0.1, 0.1], [2 + 0.5, 0.5]])
