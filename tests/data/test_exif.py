"""EXIF: COLMAP finds the same focal lengths, views are set upright, nothing hostile is believed."""

import struct

import cv2
import numpy as np
import pycolmap
import pytest
from exif_files import set_exif, tiff, with_tiff
from numpy.testing import assert_array_equal

from mkpc_kaggle.data.exif import Exif, read_exif
from mkpc_kaggle.data.images import Image, read_image
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
    assert isinstance(image, Image)
    assert_array_equal(
        image.pixels, cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[..., ::-1]
    )
    upright = cv2.imread(str(path))[..., ::-1]
    shown = np.rot90(image.pixels, image.turns)
    assert_array_equal(shown, upright[:, ::-1] if orientation in {2, 4, 5, 7} else upright)


@pytest.mark.parametrize(
    "tags",
    [
        {"tA405": 28},
        {"tA405": 28, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
        {"tA405": 0, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
        {"t920A": (42, 10), "tA20E": (100, 1), "tA210": 3},
        {"t920A": (42, 10), "tA20E": (101, 10), "tA210": 4},
        {"t920A": (42, 10), "tA20E": (10, 1001), "tA210": 5},
        {"t920A": (42, 10), "tA20E": (250, 1)},
        {"t920A": (42, 10), "tA20E": (250, 1), "tA210": 1},
        {"t920A": (42, 10)},
        {},
    ],
)
@pytest.mark.parametrize("order", "<>")
def test_the_focal_length_is_that_of_colmap(tmp_path, tags, order):
    path = write(tmp_path / "a.jpg", 6, order=order, **tags)
    camera = pycolmap.infer_camera_from_image(path)
    image = read_image(path)
    assert isinstance(image, Image)
    assert image.focal == pytest.approx(camera.focal_length if camera.has_prior_focal_length else 0, rel=1e-6)


@pytest.mark.parametrize(
    "tags",
    [
        {"tA405": 65535},
        {"tA405": 1},
        {"t920A": (0, 0), "tA20E": (250, 1), "tA210": 2},
        {"t920A": (4, 1), "tA20E": (250, 0), "tA210": 2},
        {"t920A": (4_000_000_000, 1), "tA20E": (4_000_000_000, 1), "tA210": 5},
        {"tA405": "28 mm"},
    ],
)
def test_a_focal_length_that_no_camera_has_is_unknown(tmp_path, tags):
    image = read_image(write(tmp_path / "a.jpg", **tags))
    assert isinstance(image, Image)
    assert image.focal == 0


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_orientation_that_does_not_exist_changes_nothing(tmp_path, orientation):
    image = read_image(write(tmp_path / "a.png", orientation))
    assert isinstance(image, Image)
    assert image.turns == 0


def test_exif_that_is_cut_off_or_damaged_is_missing_and_what_stands_before_it_counts():
    whole = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    part = tiff({0x0112: 6}, {0xA405: 28, 0x920A: (4, 1)})
    assert read_exif(memoryview(with_tiff(whole, part)), SIZE) == Exif(3, pytest.approx(46.663, abs=1e-3))
    for length in range(len(part)):
        found = read_exif(memoryview(with_tiff(whole, part[:length])), SIZE)
        assert found.turns == (3 if length >= 20 else 0)
    rng = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(with_tiff(whole, part))
        data[rng.integers(100)] = rng.integers(256)
        found = read_exif(memoryview(data), SIZE)
        assert 0 <= found.turns <= 3
        assert found.focal == 0 or 12 <= found.focal <= 1200
    far = struct.pack("<I", 0xFFFFFFF0)
    assert read_exif(memoryview(with_tiff(whole, b"II*\0" + far)), SIZE) == Exif()
