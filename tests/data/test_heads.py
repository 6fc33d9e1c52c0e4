"""One reader of size, orientation and focal length for every format that OpenCV decodes."""

import warnings
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pycolmap
import pytest
from numpy.testing import assert_array_equal

from mkpc_kaggle.data.heads import is_whole_png
from mkpc_kaggle.data.images import Image, Unreadable, read_image, read_size

PIXELS = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
# Pillow's names of the formats that keep EXIF
WITH_EXIF = ["JPEG", "PNG", "WEBP", "TIFF"]


def write(path: Path, form: str, orientation: int = 6) -> Path:
    """Write a picture with an orientation and a focal length of 28 mm on film of 35 mm."""
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    exif[0x8769] = {0xA405: 28}
    PIL.Image.fromarray(PIXELS).save(path, form, exif=exif.tobytes())
    return path


@pytest.fixture
def small_limit(monkeypatch):
    """Pillow's limit, which a photograph of 200 megapixels exceeds, at 100 pixels."""
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("form", WITH_EXIF)
def test_a_photograph_above_the_limit_of_pillow_keeps_its_exif(tmp_path, small_limit, form):
    # The suffix says nothing: WebP is often called .jpg.
    path = write(tmp_path / "a.jpg", form)
    image = read_image(path)
    assert image.turns == 3
    assert image.focal == pytest.approx(28 / 43.27 * np.hypot(60, 40), rel=1e-6)
    assert read_size(path) == image.size == (60, 40)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiff_is_read_as_stored_as_colmap_reads_it(tmp_path, orientation):
    path = tmp_path / "a.tif"
    PIL.Image.fromarray(PIXELS).save(path, tiffinfo={0x0112: orientation})
    image = read_image(path)
    assert_array_equal(pycolmap.Bitmap.read(str(path), as_rgb=True).to_array(), PIXELS)
    assert_array_equal(image.pixels, PIXELS)
    assert read_size(path) == (60, 40)
    # The same turns as for a JPEG with this orientation
    jpeg = read_image(write(tmp_path / "a.jpg", "JPEG", orientation))
    assert image.turns == jpeg.turns


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "bmp", "ppm", "jp2", "hdr"])
def test_the_size_is_known_before_a_run_for_all_that_opencv_decodes(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    assert cv2.imwrite(str(path), PIXELS)
    assert read_size(path) == read_image(path).size == (60, 40)


SMOOTH = cv2.GaussianBlur(np.repeat(np.repeat(PIXELS, 4, 0), 4, 1), (0, 0), 5)


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)])
def test_a_jpeg_may_lack_its_end_mark_and_nothing_else(tmp_path, options):
    whole = cv2.imencode(".jpg", SMOOTH, options)[1].tobytes()
    assert whole.endswith(b"\xff\xd9")
    path = tmp_path / "a.jpg"
    path.write_bytes(whole)
    expected = read_image(path).pixels
    for missing in (1, 2):
        path.write_bytes(whole[:-missing])
        image = read_image(path)
        assert isinstance(image, Image), missing
        assert_array_equal(image.pixels, expected)
    for missing in (20, 200, len(whole) // 2):
        path.write_bytes(whole[:-missing])
        assert isinstance(read_image(path), Unreadable), missing


def test_a_format_that_is_not_decoded_is_named_with_the_remedy(tmp_path):
    told = {
        # As an iPhone's photograph under the name of a JPEG
        "a.jpg": (b"\0\0\0\x18ftypheic" + bytes(500), "a HEIC file, which cannot be decoded here"),
        "b.dng": (b"II*\0" + bytes(500), ".dng files cannot be decoded here; convert it to JPEG"),
        "c.jpg": (b"no picture", "not a picture, or cut off"),
    }
    for name, (content, reason) in told.items():
        (tmp_path / name).write_bytes(content)
        assert read_image(tmp_path / name).reason.startswith(reason)


def test_a_png_without_its_size_is_not_whole():
    start, end = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
    assert not is_whole_png(start + end)
