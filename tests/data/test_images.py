"""Decoding: pixels, reasons of unreadable files, the store that decodes once; EXIF as in COLMAP."""

import os
import threading
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pycolmap
import pytest
from exif_files import set_exif
from numpy.testing import assert_array_equal
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from mkpc_kaggle.data import images
from mkpc_kaggle.data.images import (
    ByteCache,
    Image,
    ImageStore,
    Unreadable,
    content_digest,
    read_image,
)


def write(path, pixels, *options):
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    order = {4: cv2.COLOR_RGBA2BGRA, 3: cv2.COLOR_RGB2BGR}.get(channels)
    stored = pixels if order is None else cv2.cvtColor(pixels, order)
    done, data = cv2.imencode(path.suffix, stored, options)
    assert done
    path.write_bytes(data.tobytes())
    return path


def noise(*shape, kind=np.uint8):
    rng = np.random.default_rng(0)
    return rng.integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)


def reason(path):
    answer = read_image(path)
    assert isinstance(answer, Unreadable)
    assert answer.name == str(path)
    assert str(answer) == f"{path}: {answer.reason}"
    return answer.reason


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (5, 7, 3), (5, 7, 4)])
def test_a_png_has_three_channels_of_eight_bits(tmp_path, shape, kind):
    pixels = noise(*shape, kind=kind)
    image = read_image(write(tmp_path / "a.png", pixels))
    # The upper byte of sixteen bits; without the fourth channel, which is transparency.
    divisor = 256 if kind is np.uint16 else 1
    bytes_ = (pixels // divisor).reshape(*shape[:2], -1)[..., :3]
    assert_array_equal(image.pixels, np.broadcast_to(bytes_, (*shape[:2], 3)))
    assert image.name == str(tmp_path / "a.png")
    assert image.size == shape[1::-1]
    assert image.pixels.dtype == np.uint8
    assert len(shape) == 3 or (image.gray == bytes_[..., 0]).all()


def test_a_file_that_is_not_a_picture_has_its_reason(tmp_path):
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("no picture at all\n" * 100)
    (tmp_path / "directory.png").mkdir()
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "device.png").symlink_to("/dev/zero")  # it never ends
    assert reason(tmp_path / "empty.png") == "the file is empty"
    assert "not a picture" in reason(tmp_path / "text.png")
    bands = ImageFileDirectory_v2()
    bands.update({0x0102: (16,) * 5, 0x0115: 5})
    (tmp_path / "bands.tif").write_bytes(b"II*\0\x08\0\0\0" + bands.tobytes(8))
    assert reason(tmp_path / "bands.tif").startswith(
        "a TIFF file of another kind than 1, 3 or 4 "
    )
    # The limit is 32 : 1.
    long = "300 x 3 pixels: one side is more than 32 times the other"
    assert reason(write(tmp_path / "line.png", noise(3, 300))) == long
    assert isinstance(read_image(write(tmp_path / "strip.png", noise(10, 300))), Image)
    assert "cannot be read" in reason(tmp_path / "directory.png")
    assert reason(tmp_path / "none.png") == "no such file"
    # A name that is not UTF-8 must be printable.
    not_text = read_image(tmp_path / os.fsdecode(b"\xff.png"))
    assert str(not_text) == f"{tmp_path}/\\udcff.png: no such file"
    for name in ("pipe.png", "device.png"):
        assert reason(tmp_path / name) == "cannot be read: not a regular file"


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp", ".ppm", ".jp2"])
def test_a_file_that_is_cut_off_is_refused(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", noise(600, 400, 3))
    whole = path.read_bytes()
    image = read_image(path)
    assert isinstance(image, Image)
    # As a maker's notes after the picture
    path.write_bytes(whole + b"notes" * 100)
    assert_array_equal(read_image(path).pixels, image.pixels)
    for length in (100, len(whole) // 2, len(whole) - 200):
        path.write_bytes(whole[:length])
        assert reason(path)


@pytest.fixture
def decoded(monkeypatch):
    """Paths in the order in which they were decoded; a file called ``bad`` is unreadable."""
    seen: list[Path] = []

    def fake(path):
        seen.append(path)
        pixels = np.zeros((10, 10, 3), np.uint8)
        return (
            Unreadable(str(path), "bad") if path.name == "bad" else Image(str(path), pixels)
        )

    monkeypatch.setattr(images, "read_image", fake)
    return seen


def test_prefetched_images_are_decoded_in_the_background(monkeypatch):
    # 60 s only end a test that fails: nothing is decoded before `go`.
    go = threading.Event()
    image = Image("a", np.zeros((1, 1, 3), np.uint8))
    monkeypatch.setattr(images, "read_image", lambda path: image if go.wait(60) else None)
    with closing(ImageStore()) as store:
        store.prefetch([Path("a")])  # comes back although nothing can be decoded yet
        go.set()
        assert store.get(Path("a")) is image


def test_a_file_is_decoded_once_unless_it_made_room_or_is_unreadable(decoded):
    with closing(ImageStore(limit_bytes=1200)) as store:  # three images with gray values
        store.prefetch([Path("a"), Path("b"), Path("a")])
        for name in ("a", "b", "c", "a", "d", "a", "b", "bad", "bad"):
            store.get(Path(name))
    assert [path.name for path in decoded] == ["a", "b", "c", "d", "b", "bad", "bad"]
    # An image above the limit is handed out all the same
    with closing(ImageStore(limit_bytes=399)) as small:
        assert [small.get(Path("a")).name for _ in range(2)] == ["a", "a"]
    assert len(decoded) == 9


def test_images_that_nobody_asks_for_are_dropped_or_counted_in_the_limit(decoded):
    # As with two workers: each prefetches pairs that the other one gets.
    size = Image("a", np.zeros((10, 10, 3), np.uint8)).nbytes
    with closing(ImageStore(limit_bytes=5 * size)) as store:
        for number in range(0, 400, 8):
            store.get(Path(str(number)))
            store.prefetch([Path(str(number + 8 * k)) for k in range(1, 4)])
            store.prefetch([Path(f"other {number + k}") for k in range(4)])
            assert store._images.bytes <= 5 * size
            assert len(store._pending) <= 4 + 1, "the latest images, and one in work"
        # Images in the cache are not decoded again.
        latest = decoded[-1]
        store.get(latest)
        store.get(latest)
    assert decoded.count(latest) == 1


def test_a_cache_drops_the_entries_that_were_used_least_recently():
    cache = ByteCache(3)
    for key in "abc":
        cache.put(key, key, 1)
    assert cache.get("a") == "a"
    cache.put("d", "d", 1)
    assert [cache.get(key) for key in "bcda"] == [None, "c", "d", "a"]
    cache.put("c", "new", 2)  # instead of the former value and of d
    cache.put("e", "e", 4)  # too large
    assert [cache.get(key) for key in "acde"] == ["a", "new", None, None]
    assert cache.bytes == 3


def test_the_digest_of_a_file_is_that_of_its_bytes(tmp_path):
    path = write(tmp_path / "a.png", noise(5, 7))
    version = read_image(path).version
    os.utime(path, (1, 1))  # a copied or downloaded file has another time
    assert content_digest(path) == version
    write(path, noise(5, 7) + 1)
    assert content_digest(path) != version


PIXELS = noise(40, 60, 3)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("suffix", "order"), [(".jpg", "<"), (".png", ">")])
def test_stored_pixels_are_read_and_views_set_upright_as_by_opencv(
    tmp_path, orientation, suffix, order
):
    path = set_exif(write(tmp_path / f"a{suffix}", PIXELS), orientation, order=order)
    image = read_image(path)
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert_array_equal(image.pixels, stored[..., ::-1])
    upright = cv2.imread(str(path))[..., ::-1]
    shown = np.rot90(image.pixels, image.turns)
    # Four of the eight orientations are mirrored, which no camera writes: quarter turns remain.
    assert_array_equal(shown, upright[:, ::-1] if orientation in {2, 4, 5, 7} else upright)


POSSIBLE = [  # a focal length for film of 35 mm; a focal length, a resolution, and its unit
    {"tA405": 28},
    {"tA405": 28, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
    {"tA405": 0, "t920A": (42, 10), "tA20E": (250, 1), "tA210": 2},
    *(
        {"t920A": (42, 10), "tA20E": by, "tA210": n}
        for n, by in ((3, (100, 1)), (4, (101, 10)), (5, (10, 1001)))
    ),
    {"t920A": (42, 10), "tA20E": (250, 1), "tA210": 1},
    {},
]


@pytest.mark.parametrize("tags", POSSIBLE)
@pytest.mark.parametrize("order", "<>")
def test_the_focal_length_is_that_of_colmap(tmp_path, tags, order):
    path = set_exif(write(tmp_path / "a.jpg", PIXELS), 6, order=order, **tags)
    camera = pycolmap.infer_camera_from_image(path)
    expected = camera.focal_length if camera.has_prior_focal_length else 0
    assert read_image(path).focal == pytest.approx(expected, rel=1e-6)


# A focal length of 4.2 mm on 10 pixels per millimetre, which EXIF calls 42 recorded pixels
PLANE = {"t920A": (42, 10), "tA20E": (100, 1), "tA210": 3}
RECORDED = {
    "as it was taken": ({"tA002": 60, "tA003": 40}, 42),
    "reduced three times": ({"tA002": 180, "tA003": 120}, 14),
    "rotated and reduced": ({"tA002": 80, "tA003": 120}, 21),
    "only the width is known": ({"tA002": 120}, 21),
    "cropped, by an unknown part": ({"tA002": 120, "tA003": 120}, 0),
    "no size": ({}, 42),
}


@pytest.mark.parametrize(("recorded", "expected"), RECORDED.values(), ids=RECORDED)
def test_a_focal_length_by_the_sensor_is_that_of_the_stored_pixels(
    tmp_path, recorded, expected
):
    path = set_exif(write(tmp_path / "a.jpg", PIXELS), 1, **PLANE, **recorded)
    assert read_image(path).focal == pytest.approx(expected)


# Far from any lens, divisions by zero, and text.
IMPOSSIBLE = [
    {"tA405": 65535},
    {"tA405": 1},
    {"t920A": (0, 0), "tA20E": (250, 1), "tA210": 2},
    {"t920A": (4, 1), "tA20E": (250, 0), "tA210": 2},
    {"tA405": "28 mm"},
]


@pytest.mark.parametrize("tags", IMPOSSIBLE)
def test_an_impossible_focal_length_or_orientation_is_unknown(tmp_path, tags):
    image = read_image(set_exif(write(tmp_path / "a.jpg", PIXELS), 9, **tags))
    assert (image.focal, image.turns) == (0, 0)


# Pillow's names of the formats that keep EXIF. The suffix says nothing: WebP is often called .jpg.
@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", [1, 6, 7])
def test_each_format_has_its_stored_pixels_and_its_exif(tmp_path, form, orientation):
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    exif[0x8769] = {0xA405: 28}
    path = tmp_path / "a.jpg"
    PIL.Image.fromarray(PIXELS).save(path, form, exif=exif.tobytes(), lossless=True)
    image = read_image(path)
    assert image.turns == images.TURNS.get(orientation, 0)
    assert image.focal == pytest.approx(28 / 43.27 * np.hypot(60, 40), rel=1e-6)
    assert images.read_size(path) == image.size == (60, 40)
    if form != "JPEG":
        assert_array_equal(image.pixels, PIXELS)
