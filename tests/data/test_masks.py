"""Masks as people make them: named in other ways, of other depths, of colours."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

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


KINDS: dict[str, Callable[[Path], None]] = {
    "gray": lambda path: save(HALF, path),
    "one bit": lambda path: PIL.Image.fromarray(HALF).convert("1").save(path),
    "16 bits, 0 and 1": lambda path: cv2.imwrite(str(path), (HALF > 0).astype(np.uint16)),
    "palette": palette,
    "opaque": lambda path: save(np.dstack([HALF, HALF, HALF, WHITE[..., 0]]), path),
    "one channel": lambda path: save(np.dstack([HALF, 0 * HALF, 0 * HALF]), path),
}


@pytest.mark.parametrize("kind", KINDS)
def test_black_pixels_are_left_out_and_no_others(tmp_path, kind):
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
    assert masks_of(folder).line == "masks: 1 of 5 images"


def test_the_reader_keeps_points_on_white_pixels(folder):
    save(HALF, folder / "M" / "0.png.png")
    reader = MaskReader(masks_of(folder))
    points = np.array([[2.0, 3.0], [20.0, 3.0], [29.4, 19.4]])
    size = Size(HALF.shape[1], HALF.shape[0])
    for name, kept in (("0.png", [False, True, True]), ("1.png", [True] * 3)):
        assert reader.shows(str(folder / "I" / name), points, size).tolist() == kept


def test_a_folder_without_masks_and_an_unreadable_mask_are_refused(folder):
    with pytest.raises(UserError, match=r"has no mask of any image: 0\.png\.png would be"):
        masks_of(folder)
    with pytest.raises(UserError, match="has images of the run"):
        Masks.of_folder(folder / "I", folder / "I", [folder / "I" / "0.png"])
    (folder / "M" / "3.png.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"the mask .*3\.png\.png cannot be read"):
        masks_of(folder)


@pytest.mark.parametrize("form", ["WEBP", "TIFF", "BMP"])
def test_a_mask_of_another_size_is_refused_whatever_the_format_of_its_image(folder, form):
    PIL.Image.fromarray(WHITE).save(folder / "I" / "0.png", form)
    save(HALF[:10], folder / "M" / "0.png.png")
    with pytest.raises(UserError, match="has 30 x 10 pixels, its image 30 x 20"):
        masks_of(folder)
