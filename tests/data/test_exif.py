"""EXIF: COLMAP finds the same focal lengths, views are set upright, nothing hostile is believed."""

import cv2
import numpy as np
import pycolmap
import pytest
from exif_files import set_exif, tiff, with_tiff
from numpy.testing import assert_array_equal

from mkpc_kaggle.data.images import read_exif, read_image
from mkpc_kaggle.geometry.coordinates import Size

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
SIZE = Size(60, 40)


def write(path, *tags, **more):
    cv2.imwrite(str(path), PIXELS)
    return set_exif(path, *tags, **more)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("order", "<>")
def test_stored_pixels_are_read_and_views_set_upright_as_by_opencv(tmp_path, orientation, suffix, order):
    path = write(tmp_path / f"a{suffix}", orientation, order=order)
    image = read_image(path)
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert_array_equal(image.pixels, stored[..., ::-1])
    upright = cv2.imread(str(path))[..., ::-1]
    shown = np.rot90(image.pixels, image.turns)
    assert_array_equal(shown, upright[:, ::-1] if orientation in {2, 4, 5, 7} else upright)


POSSIBLE = [  # a focal length for film of 35 mm; a focal length, a resolution, and its unit
    {"tA405": 28},
    {"tA405": 28, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
    {"tA405": 0, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
    *({"t920A": (42, 10), "tA20E": by, "tA210": n} for n, by in ((3, (100, 1)), (4, (101, 10)), (5, (10, 1001)))),
    {"t920A": (42, 10), "tA20E": (250, 1), "tA210": 1},
    {},
]


@pytest.mark.parametrize("tags", POSSIBLE)
@pytest.mark.parametrize("order", "<>")
def test_the_focal_length_is_that_of_colmap(tmp_path, tags, order):
    path = write(tmp_path / "a.jpg", 6, order=order, **tags)
    camera = pycolmap.infer_camera_from_image(path)
    image = read_image(path)
    assert image.focal == pytest.approx(camera.focal_length if camera.has_prior_focal_length else 0, rel=1e-6)


IMPOSSIBLE = [
    {"tA405": 65535},
    {"tA405": 1},
    {"t920A": (0, 0), "tA20E": (250, 1), "tA210": 2},
    {"t920A": (4, 1), "tA20E": (250, 0), "tA210": 2},
    {"tA405": "28 mm"},
]


@pytest.mark.parametrize("tags", IMPOSSIBLE)
def test_a_focal_length_or_an_orientation_that_cannot_be_is_unknown(tmp_path, tags):
    image = read_image(write(tmp_path / "a.jpg", 9, **tags))
    assert (image.focal, image.turns) == (0, 0)


def test_damaged_exif_is_missing():
    whole, rng = cv2.imencode(".jpg", PIXELS)[1].tobytes(), np.random.default_rng(0)
    part = tiff(6, tA405=28, t920A=(4, 1))
    assert read_exif(with_tiff(whole, part), SIZE) == (3, pytest.approx(46.663, abs=1e-3))
    damaged = [part[:length] for length in range(len(part))]
    for _ in range(300):
        data = bytearray(part)
        data[rng.integers(len(part))] = rng.integers(256)
        damaged.append(bytes(data))
    for data in damaged:
        turns, focal = read_exif(with_tiff(whole, data), SIZE)
        assert turns in range(4)
        assert focal == 0 or 12 <= focal <= 1200
