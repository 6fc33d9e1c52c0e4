"""Folders whose images have no matches: a final result with its cause, and not one to wait for."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import run_command

from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.reconstruction.unmatched import cause_of_no_matches

SIZE = (240, 320)


def write(folder: Path, scale: float = 1.0, count: int = 3) -> Path:
    """Write photographs of one thing, whose values are multiplied by ``scale``."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (300, 400, 3), np.uint8), (0, 0), 2)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    for number in range(count):
        part = scene[number * 9 :, number * 11 :][: SIZE[0], : SIZE[1]]
        cv2.imwrite(str(folder / f"{number}.png"), (part * scale).astype(np.uint8))
    return folder


def write_masks(folder: Path, images: Path, value: int) -> Path:
    folder.mkdir()
    for image in images.iterdir():
        cv2.imwrite(str(folder / f"{image.name}.png"), np.full(SIZE, value, np.uint8))
    return folder


@pytest.mark.parametrize("is_dark", [True, False])
def test_no_match_at_all_is_a_result_with_its_cause(tmp_path, capsys, is_dark):
    root = write(tmp_path / "photos", 0.01 if is_dark else 1)
    out = tmp_path / "out"
    recipe = tmp_path / "one.toml"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 320 }]\n[scene]\n')
    options = ["--recipe", recipe, "--workers", 0]
    cause = "the photographs are almost black: the maximum of 0.png is 2 of 255"
    if not is_dark:
        options += ["--masks", write_masks(tmp_path / "masks", root, 0)]
        cause = "the masks hide everything"
    for _ in range(2):
        assert run_command("reconstruct", root, "--out", out, *options) == 1
        text = capsys.readouterr().out
        assert "photos: 0 of 3 images with a camera: no matches connect its images" in text
        assert f"fault: photos: {cause}" in text
        assert "continue" not in text
    facts = json.loads((out / "summary.json").read_text())
    (problem,) = facts["problems"]
    assert problem.startswith(f"no cameras, no matches connect its images: {cause}")
    assert facts["verdict"].startswith("0 of 3 images with a camera")


def test_causes_are_named_only_if_the_files_show_them(tmp_path):
    root = write(tmp_path / "photos", count=5)
    files = sorted(root.iterdir())
    assert cause_of_no_matches(files, Masks()) == ""
    white = Masks.of_folder(write_masks(tmp_path / "white", root, 255), root, files)
    assert cause_of_no_matches(files, white) == ""
    black = write_masks(tmp_path / "black", root, 0)
    assert "masks hide everything" in cause_of_no_matches(
        files, Masks.of_folder(black, root, files)
    )
    # One image is used whole.
    (black / "2.png.png").unlink()
    assert cause_of_no_matches(files, Masks.of_folder(black, root, files)) == ""
    flat = tmp_path / "flat"
    flat.mkdir()
    for number in range(2):
        cv2.imwrite(str(flat / f"{number}.png"), np.full((20, 20), 200 + number, np.uint8))
    assert "has one brightness" in cause_of_no_matches(sorted(flat.iterdir()), Masks())


def test_two_images_are_too_few_for_cameras_and_the_line_says_so(tmp_path, capsys):
    root = write(tmp_path / "photos", count=2)
    recipe = tmp_path / "one.toml"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 320 }]\n[scene]\n')
    options = ["--out", tmp_path / "out", "--recipe", recipe, "--workers", 0]
    assert run_command("reconstruct", root, *options) == 1
    line = "photos: 0 of 2 images with a camera: 1 pair; cameras need at least three matched images"
    assert line in capsys.readouterr().out
