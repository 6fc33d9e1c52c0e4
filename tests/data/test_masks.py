"""Masks as people make them: named in other ways, of other depths, transparent, empty."""

import unicodedata
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from mkpc_kaggle.data import masks
from mkpc_kaggle.data.masks import MaskReader, Masks, read_mask
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size

# The left half is hidden.
HALF = np.full((20, 30), 255, np.uint8)
HALF[:, :15] = 0
WHITE = np.full((20, 30, 3), 255, np.uint8)


def save(array: np.ndarray, path: Path) -> None:
    PIL.Image.fromarray(array).save(path, "PNG")


def palette(path: Path) -> None:
    picture = PIL.Image.fromarray((HALF > 0).astype(np.uint8))
    picture.putpalette([0, 0, 0, 0, 0, 255])
    picture.save(path)


def turned_tiff(path: Path) -> None:
    PIL.Image.fromarray(HALF).save(path, "TIFF", tiffinfo={0x0112: 6})


KINDS: dict[str, Callable[[Path], None]] = {
    "gray": lambda path: save(HALF, path),
    "one bit": lambda path: PIL.Image.fromarray(HALF).convert("1").save(path),
    "0 and 1": lambda path: save((HALF > 0).astype(np.uint8), path),
    "16 bits, 0 and 255": lambda path: cv2.imwrite(str(path), HALF.astype(np.uint16)),
    "16 bits, 0 and 1": lambda path: cv2.imwrite(str(path), (HALF > 0).astype(np.uint16)),
    "palette": palette,
    "one channel": lambda path: save(np.dstack([HALF, 0 * HALF, 0 * HALF]), path),
    "white with alpha": lambda path: save(np.dstack([WHITE, HALF]), path),
    "gray with alpha": lambda path: save(np.dstack([WHITE[..., 0], HALF]), path),
    "turned TIFF": turned_tiff,
}


@pytest.mark.parametrize("kind", KINDS)
def test_black_and_transparent_pixels_are_left_out_and_no_others(tmp_path, kind):
    KINDS[kind](tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), HALF > 0)


@pytest.fixture
def folder(tmp_path):
    """A folder of five images, and one for masks."""
    (tmp_path / "I").mkdir()
    (tmp_path / "M").mkdir()
    for number in range(5):
        save(WHITE, tmp_path / "I" / f"{number}.png")
    return tmp_path


def masks_of(folder: Path) -> Masks:
    return Masks.of_folder(folder / "M", folder / "I", sorted((folder / "I").iterdir()))


def test_the_masks_that_take_effect_are_counted(folder):
    save(HALF, folder / "M" / "0.png.png")
    for number in range(1, 5):
        save(HALF, folder / "M" / f"{number}.png")
    masks = masks_of(folder)
    assert masks.is_partial
    (line,) = masks.lines
    assert line.startswith("masks: 1 of 5 images; 4 files of ")
    assert line.endswith("/M belong to none, the first is 1.png")


def test_masks_of_all_images_are_one_line(folder):
    for number in range(5):
        save(HALF, folder / "M" / f"{number}.png.png")
    assert masks_of(folder).lines == ("masks: 5 of 5 images",)
    assert not masks_of(folder).is_partial


def test_a_mask_that_changes_during_the_run_is_refused(folder):
    """Points are stored under the digest of the mask at the start."""
    save(HALF, folder / "M" / "0.png.png")
    masks = masks_of(folder)
    image = str(folder / "I" / "0.png")
    points = np.array([[2.0, 3.0], [20.0, 3.0]])
    size = Size(HALF.shape[1], HALF.shape[0])
    assert MaskReader(masks).shows(image, points, size).tolist() == [False, True]
    save(255 - HALF, folder / "M" / "0.png.png")
    with pytest.raises(UserError, match="has changed during the run"):
        MaskReader(masks).shows(image, points, size)


def test_masks_that_hide_everything_or_nothing_are_named(folder):
    save(0 * HALF, folder / "M" / "0.png.png")
    save(0 * HALF, folder / "M" / "1.png.png")
    # The black of a JPEG is not 0.
    save(np.maximum(HALF, 2), folder / "M" / "2.png.png")
    _, everything, nothing = masks_of(folder).lines
    assert everything == f"masks that hide everything: 2, the first is {folder}/M/0.png.png"
    assert nothing.startswith("masks that hide nothing, since only black")
    assert nothing.endswith(f": 1, the first is {folder}/M/2.png.png")


def test_of_many_masks_some_are_decoded_and_all_are_checked(folder, monkeypatch):
    monkeypatch.setattr(masks, "MAX_DECODED", 2)
    decoded = []
    monkeypatch.setattr(masks, "read_mask", lambda path: decoded.append(path) or read_mask(path))
    # So small pictures may have one colour, whatever they show.
    monkeypatch.setattr(masks, "may_have_one_colour", lambda _: False)
    noise = np.random.default_rng(0).integers(0, 2, (5, *HALF.shape), np.uint8) * 255
    for number in range(5):
        save(noise[number], folder / "M" / f"{number}.png.png")
    assert masks_of(folder).lines == ("masks: 5 of 5 images",)
    assert [path.name for path in decoded] == ["0.png.png", "4.png.png"]
    # The others are no less refused.
    save(noise[2].T, folder / "M" / "2.png.png")
    with pytest.raises(
        UserError, match=r"2\.png\.png has 20 x 30 pixels, its image 30 x 20; masks"
    ):
        masks_of(folder)
    # A whole file of chunks, and no size
    no_size = b"\x89PNG\r\n\x1a\n\0\0\0\0IEND\xaeB`\x82"
    for damaged in (b"no picture", b"", no_size):
        (folder / "M" / "2.png.png").write_bytes(damaged)
        with pytest.raises(UserError, match=r"2\.png\.png cannot be read"):
            masks_of(folder)
    # A file that does not fit its checksums is decoded.
    save(noise[2], folder / "M" / "2.png.png")
    data = bytearray((folder / "M" / "2.png.png").read_bytes())
    data[-20] ^= 255
    (folder / "M" / "2.png.png").write_bytes(data)
    decoded.clear()
    with suppress(UserError):  # OpenCV decides
        masks_of(folder)
    assert folder / "M" / "2.png.png" in decoded
    # Nor has another format checksums.
    PIL.Image.fromarray(0 * HALF).save(folder / "M" / "2.png.png", "BMP")
    _, everything = masks_of(folder).lines
    assert everything.startswith("masks that hide everything: 1 of 3 that were decoded")


@pytest.mark.parametrize("shape", [(20, 30), (480, 640), (900, 1200)])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("write", [save, lambda array, path: cv2.imwrite(str(path), array)])
def test_of_many_masks_those_of_one_colour_are_all_named_and_copies_are_decoded_once(
    folder, monkeypatch, shape, channels, write
):
    monkeypatch.setattr(masks, "MAX_DECODED", 1)
    decoded = []
    monkeypatch.setattr(masks, "read_mask", lambda path: decoded.append(path) or read_mask(path))
    size = shape if channels == 1 else (*shape, channels)
    noise = np.random.default_rng(0).integers(0, 2, size, np.uint8) * 255
    for number in range(5):
        PIL.Image.new("RGB", shape[::-1]).save(folder / "I" / f"{number}.png")
        write(noise if number == 0 else 0 * noise, folder / "M" / f"{number}.png.png")
    _, everything = masks_of(folder).lines
    assert everything.startswith("masks that hide everything: 4, the first is")
    assert len(decoded) == 2


def test_equal_names_may_be_written_in_two_ways(folder):
    name = "\N{LATIN SMALL LETTER E WITH ACUTE}.png"
    save(WHITE, folder / "I" / unicodedata.normalize("NFD", name))
    save(HALF, folder / "M" / f"{unicodedata.normalize('NFC', name)}.PNG")
    masks = masks_of(folder)
    assert masks.lines == ("masks: 1 of 6 images",)


@pytest.mark.parametrize("form", ["WEBP", "TIFF", "BMP"])
def test_a_mask_of_another_size_is_refused_whatever_the_format_of_its_image(folder, form):
    PIL.Image.fromarray(WHITE).save(folder / "I" / "0.png", form)
    save(HALF[:10], folder / "M" / "0.png.png")
    with pytest.raises(UserError, match="has 30 x 10 pixels, its image 30 x 20"):
        masks_of(folder)
