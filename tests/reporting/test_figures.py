"""The strip of a pair: images, points and lines are where they should be."""

import cv2
import numpy as np
import pytest

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind
from mkpc_kaggle.pipeline.drawing import draw_strip
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.reporting.figures import encode


def gray(size, level):
    pixels = np.full((size.height, size.width, 3), level, np.uint8)
    return Image.of_array(pixels)


def test_a_strip_shows_both_images_upright_at_one_height_with_matches_where_they_are():
    # 100 wide in its file, and 200 when it is upright
    lying = gray(Size(100, 200), 250).turned(1)
    square = gray(Size(300, 300), 5)
    point0 = np.array([[89.5, 9.5]])
    point1 = np.array([[149.5, 149.5]])
    result = UnitResult(Unit(1, "sift", 100), Matches(point0, point1, np.ones(1)))
    found = Estimate(ModelKind.F, np.eye(3), np.array([True]))
    figure = draw_strip((lying, square), PairMatch((result,), None, found))
    jpeg = np.frombuffer(encode(figure), np.uint8)
    drawn = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    # Older versions of matplotlib round down
    assert drawn.shape[:2] == pytest.approx((480, 960 + 480), abs=1)
    assert drawn[400, 100].min() > 200
    assert drawn[400, 1400].max() < 50
    drawn_points = [dots.get_offsets() for dots in figure.axes[0].collections]
    (ends,) = (points for points in drawn_points if len(points) > 1)
    np.testing.assert_allclose(ends, [[0.1, 0.1], [2 + 0.5, 0.5]])
