"""Boxes and views: the maps are each other's inverse, and the rendered pixels are where the maps
say.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mkpc_kaggle.geometry.coordinates import Box, Size, View, from_corner, from_normalised

SIDES = st.integers(1, 3000)
TURNS = st.integers(0, 3)
SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def boxes(draw):
    left = draw(st.integers(-500, 3000))
    top = draw(st.integers(-500, 3000))
    return Box(left, top, left + draw(SIDES), top + draw(SIDES))


@st.composite
def views(draw):
    # Any aspect: the scales of x and y are two numbers.
    content = Size(draw(SIDES), draw(SIDES))
    right = draw(st.integers(0, 40))
    bottom = draw(st.integers(0, 40))
    padded = Size(content.width + right, content.height + bottom)
    return View(draw(boxes()), content, padded, draw(TURNS))


# Odd and prime, so that no scale is a whole number.
IMAGE = Size(107, 71)
WHOLE = Box.whole(IMAGE)
CROP = Box(13, 8, 90, 65)
RENDERED = {
    "enlarged": View.fit(WHOLE, long_side=250),
    "cropped and enlarged": View.fit(CROP, long_side=200, multiple=32),
    "cropped and shrunk": View.fit(CROP, long_side=51, multiple=32),
    "enlarged along x, shrunk along y": View(WHOLE, Size(240, 40), Size(240, 40)),
    "cropped and turned by three quarters": View(CROP, Size(80, 48), Size(96, 48), turns=3),
}


@given(view=views(), seed=SEEDS)
@settings(max_examples=150, deadline=None)
def test_a_view_maps_points_there_and_back(view, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-4000, 4000, (20, 2))
    to_view_and_back = view.to_image(view.from_image(points))
    to_image_and_back = view.from_image(view.to_image(points))
    # Rounding alone: coordinates of 4000 are scaled by up to 3000 and back.
    assert_allclose(to_view_and_back, points, rtol=0, atol=1e-7)
    assert_allclose(to_image_and_back, points, rtol=0, atol=1e-7)


@given(turns=TURNS, scale=st.sampled_from([1, 2]), seed=SEEDS)
@settings(max_examples=50, deadline=None)
def test_a_turned_view_is_the_view_of_the_turned_picture(turns, scale, seed):
    """One grey level a pixel: each pixel of the view has the level of the stored pixel that it
    comes from.
    """
    levels = np.random.default_rng(seed).permutation(6 * 8)
    stored = levels.reshape(6, 8).astype(np.uint8)
    crop = Box(1, 2, 8, 5)
    long_side = 7 * scale
    view = View.fit(crop, long_side=long_side, multiple=4, turns=turns)
    # The same crop cut out and turned by NumPy, and seen as a whole image
    cut = stored[2:5, 1:8]
    upright = np.ascontiguousarray(np.rot90(cut, turns))
    height, width = upright.shape
    whole = Box.whole(Size(width, height))
    expected = View.fit(whole, long_side=long_side, multiple=4)
    assert (view.content, view.padded) == (expected.content, expected.padded)
    assert_array_equal(view.render(stored), expected.render(upright))
    # Only an unscaled pixel comes from one pixel.
    if scale == 1:
        y, x = np.indices(upright.shape).reshape(2, -1)
        pixels = np.column_stack([x, y])
        x0, y0 = view.to_image(pixels).astype(int).T
        assert_array_equal(stored[y0, x0], upright.ravel())


@given(
    crop=boxes(),
    long_side=SIDES,
    area=st.integers(1, 2_000_000),
    multiple=st.sampled_from([1, 8, 14, 32]),
)
@settings(max_examples=150, deadline=None)
def test_a_view_keeps_the_aspect_to_the_nearest_pixel_and_pads_to_the_multiple(
    crop, long_side, area, multiple
):
    fitted = View.fit(crop, long_side=long_side, multiple=multiple)
    assert max(fitted.content) == long_side
    by_side = long_side / max(crop.size)
    of_area = View.fit(crop, area=area, multiple=multiple)
    by_area = (area / crop.area) ** 0.5
    for view, scale in ((fitted, by_side), (of_area, by_area)):
        assert view.crop == crop
        sides = zip(crop.size, view.content, view.padded, strict=True)
        for side, content, padded in sides:
            # A crop of 1 x 3000 at a long side of 90 still has a column.
            exact = max(1, side * scale)
            assert abs(content - exact) <= 0.5 + 1e-9 * side * scale
            assert padded % multiple == 0
            assert 0 <= padded - content < multiple


def test_corner_based_and_normalised_coordinates_become_centres_at_integers():
    # Half a pixel at 640 pixels is a pixel and more in a photograph of 1600.
    corners = np.array([[0, 0], [0.5, 0.5], [30, 40]], np.float32)
    centres = from_corner(corners)
    assert centres.tolist() == [[-0.5, -0.5], [0, 0], [29.5, 39.5]]
    # The corners of an image are at -1 and 1.
    normalised = np.array([[-1, -1], [0, 0.5], [1, 1]], np.float32)
    found = from_normalised(normalised, Size(10, 40))
    assert found.tolist() == [[-0.5, -0.5], [4.5, 29.5], [9.5, 39.5]]
    assert centres.dtype == found.dtype == np.float32


@pytest.mark.parametrize("name", RENDERED)
def test_a_spot_is_rendered_where_the_map_says(name):
    centre = (41.3, 30.8)
    view = RENDERED[name]

    y, x = np.indices((IMAGE.height, IMAGE.width))
    squared = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
    # Wide enough to be sampled well where the view shrinks
    sigma = 4.0
    levels = 255 * np.exp(-squared / (2 * sigma**2))
    spot = np.rint(levels).astype(np.uint8)
    picture = view.render(spot)
    assert picture.shape == (view.padded.height, view.padded.width)
    y, x = np.indices(picture.shape)
    pixels = [x.ravel(), y.ravel()]
    centroid = np.average(pixels, axis=1, weights=picture.ravel())
    (mapped,) = view.from_image(np.array([centre]))
    # Grey levels are rounded. A map without the halves is off by at least 0.17 pixels.
    assert_allclose(centroid, mapped, rtol=0, atol=0.04)


@pytest.mark.parametrize("shape", [(71, 107), (71, 107, 3)])
def test_a_crop_that_is_not_resized_is_copied_and_padded_with_black_right_and_bottom(shape):
    # Without black pixels, so that only padding is black
    rng = np.random.default_rng(0)
    image = rng.integers(1, 256, shape, dtype=np.uint8)
    crop = Box(5, 7, 55, 37)
    picture = View.fit(crop, long_side=50, multiple=32).render(image)
    cut = image[7:37, 5:55]
    assert picture.shape == (32, 64, *shape[2:])
    assert picture.dtype == np.uint8
    assert_array_equal(picture[:30, :50], cut)
    assert not picture[30:].any()
    assert not picture[:, 50:].any()


@pytest.mark.parametrize("content", [Size(64, 16), Size(64, 19), Size(32, 16), Size(90, 16)])
def test_shrinking_averages_stripes_that_would_alias(content):
    rows = np.array([[0], [255]] * 32, np.uint8)
    stripes = np.tile(rows, (1, 64))
    whole = Box.whole(Size(64, 64))
    picture = View(whole, content, content).render(stripes)
    # Sampling without averaging gives 0 and 255, which are 127.5 away.
    assert abs(picture - 127.5).max() < 30


def test_an_empty_box_or_a_crop_that_leaves_its_image_is_an_error():
    for corners in ((0, 0, 0, 5), (0, 3, 5, 2)):
        with pytest.raises(ValueError, match="empty box"):
            Box(*corners)
    # NumPy would cut the first two silently and take the third from the other end.
    image = np.zeros((30, 40), np.uint8)
    for corners in ((0, 0, 41, 30), (0, 0, 40, 31), (-9, -9, -1, -1)):
        view = View.fit(Box(*corners), long_side=9)
        with pytest.raises(ValueError, match="leaves the image of 40 x 30"):
            view.render(image)
