"""Points as COLMAP reads files: whatever EXIF says of their orientation."""

import cv2
import numpy as np
import pytest
from exif_files import set_exif

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair


def write(path, orientation):
    cv2.imwrite(str(path), np.arange(6 * 4, dtype=np.uint8).reshape(6, 4))
    image = read_image(set_exif(path, orientation, tA405=28))
    assert isinstance(image, Image)
    return image


def every_pixel(height, width):
    y, x = np.indices((height, width)).reshape(2, -1)
    return np.column_stack([x, y]).astype(np.float32)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("turns", range(4))
def test_points_are_in_the_pixels_of_the_file(tmp_path, orientation, turns):
    image = write(tmp_path / "a.png", orientation)
    stored = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    shown = np.rot90(image.gray, turns)
    points = every_pixel(*shown.shape)
    end = BatchImage("turned", "a", image.size.__class__(*shown.shape[::-1]))
    pair = BatchPair(end, end, Matches(points, points, np.ones(len(points))))
    (moved,) = Export(tmp_path, tmp_path, {"turned": ("a.png", turns)}).stored([pair])
    assert (moved.image0.name, moved.image0.size) == ("a.png", (4, 6))
    assert moved.image0.focal == pytest.approx(28 / 43.27 * np.hypot(4, 6))
    for found in (moved.matches.points0, moved.matches.points1):
        x, y = found.astype(int).T
        np.testing.assert_array_equal(stored[y, x], shown.ravel())


def test_nothing_connects_a_mirrored_file_with_others(tmp_path):
    ends = {}
    for name, orientation in (("a", 1), ("b", 6), ("c", 2), ("d", 5)):
        image = write(tmp_path / f"{name}.png", orientation)
        ends[name] = BatchImage(name, name, image.size)
    points = every_pixel(4, 4)
    found = Matches(points, points, np.ones(16))
    pairs = [BatchPair(ends[i], ends[j], found, None, found) for i, j in ("ab", "ac", "bd", "cd")]
    moved = Export(tmp_path, tmp_path, {name: (f"{name}.png", 0) for name in ends}).stored(pairs)
    assert [len(pair.matches) for pair in moved] == [16, 0, 0, 16]
    assert [len(pair.tracks) for pair in moved] == [16, 0, 0, 16]
