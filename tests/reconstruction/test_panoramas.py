"""Panoramas of 360 degrees are refused; photographs that are twice as wide as high are not."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import run_command
from sklearn.datasets import load_sample_image

from mkpc_kaggle import reconstruct
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction.panoramas import require_perspective

HEIGHT = 256


def panorama(seed: int) -> np.ndarray:
    """Render waves on a sphere, twice as wide as high."""
    rng = np.random.default_rng(seed)
    polar = (np.arange(HEIGHT) + 0.5)[:, None] * np.pi / HEIGHT
    azimuth = (np.arange(2 * HEIGHT) + 0.5)[None] * np.pi / HEIGHT
    x = np.sin(polar) * np.cos(azimuth)
    y = np.sin(polar) * np.sin(azimuth)
    z = np.cos(polar) + 0 * azimuth
    directions = np.stack([x, y, z], axis=-1)
    values = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    for _ in range(100):
        phases = directions @ rng.normal(size=3) * rng.uniform(2, 30)
        values += rng.normal(size=3) * np.sin(phases)[..., None]
    return cv2.normalize(values, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def photograph(number: int) -> np.ndarray:
    """A part of a photograph, in the shape of a panorama."""
    left = 20 * number
    return load_sample_image("china.jpg")[left : left + 300, left : left + 2 * 300 - 40][:280]


@pytest.mark.parametrize("seed", range(3))
def test_a_panorama_is_refused_before_the_run(tmp_path, capsys, seed):
    root = tmp_path / "in"
    root.mkdir()
    for number in range(2):
        cv2.imwrite(str(root / f"{number}.png"), photograph(number))
    cv2.imwrite(str(root / "pano.png"), panorama(seed))
    assert run_command("reconstruct", root, "--out", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{root}/pano.png is a panorama of 360 degrees (512 x 256)" in line
    assert not (tmp_path / "out").exists()
    with pytest.raises(UserError, match="cut each panorama into perspective views"):
        reconstruct(sorted(root.iterdir()), "classical")


def test_a_photograph_of_that_shape_is_none_unless_its_metadata_say_so(tmp_path):
    files = [tmp_path / f"{number}.jpg" for number in range(4)]
    for number, file in enumerate(files):
        pixels = photograph(number)
        assert pixels.shape[1] == 2 * pixels.shape[0]
        cv2.imwrite(str(file), pixels)
    require_perspective(files)
    # As cameras of two lenses and stitching programs mark it
    xmp = b'<rdf GPano:ProjectionType="equirectangular"/>'
    data = files[2].read_bytes()
    segment = b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp
    files[2].write_bytes(data[:2] + segment + data[2:])
    with pytest.raises(UserError, match=r"2\.jpg is a panorama"):
        require_perspective(files)


def test_a_picture_without_structure_is_no_panorama(tmp_path: Path):
    for number, value in enumerate((0, 128)):
        file = tmp_path / f"{number}.png"
        cv2.imwrite(str(file), np.full((100, 200, 3), value, np.uint8))
        require_perspective([file])
