"""Images without a camera: a final result with its cause, and not one to wait for."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import run_command
from test_reconstruct import FIRST, run, write_flat

from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.reconstruction.causes import MAX_FILES, causes_in_files

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
        assert "0 of 3 images with a camera" in text
        assert "1 batch without cameras (no matches connect its images): photos" in text
        assert f"photos: {cause}" in text
        assert "continue" not in text


def test_causes_are_named_only_if_the_files_show_them(tmp_path):
    root = write(tmp_path / "photos", count=5)
    files = sorted(root.iterdir())
    assert list(causes_in_files(files, Masks())) == []
    assert list(causes_in_files([], Masks())) == []
    white = Masks.of_folder(write_masks(tmp_path / "white", root, 255), root, files)
    assert list(causes_in_files(files, white)) == []
    black = write_masks(tmp_path / "black", root, 0)
    # One image is used whole.
    (black / "2.png.png").unlink()
    (cause,) = causes_in_files(files, Masks.of_folder(black, root, files))
    assert cause.startswith("the masks hide everything")
    assert cause.endswith(": 0.png, 1.png, 3.png, 4.png")


def picture(folder: Path, name: str, pixels: np.ndarray) -> None:
    cv2.imwrite(str(folder / name), pixels)


def test_each_cause_names_its_images(tmp_path):
    root = write(tmp_path / "photos", count=2)
    scene = cv2.imread(str(root / "0.png"))
    picture(root, "dark.png", scene // 16)
    lamps = scene // 16
    lamps[:2, :2] = 255
    picture(root, "lamps.png", lamps)
    picture(root, "flat.png", np.full((20, 20), 200, np.uint8))
    picture(root, "white.png", np.clip(scene.astype(int) * 5 // 2, 0, 255).astype(np.uint8))
    picture(root, "hidden.png", scene)
    (root / "unreadable.png").write_bytes(b"x")
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.zeros(SIZE, np.uint8)
    mask[:, :10] = 255
    picture(masks, "hidden.png.png", mask)
    files = sorted(root.iterdir())
    given = Masks.of_folder(masks, root, files)
    causes = {cause.rpartition(": ")[2]: cause for cause in causes_in_files(files, given)}
    assert "the maximum of dark.png is 15 of 255" in causes["dark.png, lamps.png"]
    assert "all of flat.png has one brightness" in causes["flat.png"]
    assert "overexposed" in causes["white.png"]
    assert "hide almost everything, 97 % of hidden.png" in causes["hidden.png"]
    assert len(causes) == 4
    (cause,) = causes_in_files([root / "lamps.png"], Masks())
    assert "99.9 % of lamps.png are at most" in cause


def test_of_many_images_some_are_read(tmp_path):
    root = write(tmp_path / "photos", 0.01, count=MAX_FILES + 1)
    (cause,) = causes_in_files(sorted(root.iterdir()), Masks())
    assert cause.endswith(f"; 7 of {MAX_FILES + 1} files were read")


def test_images_without_a_camera_among_others_are_named_with_their_cause(tmp_path, capsys):
    # Images of one brightness, whose matches a matcher knows: the last belongs to no scene.
    root = write_flat(tmp_path / "photos", FIRST)
    other = cv2.imread(str(root / "00.png")) * 0
    cv2.imwrite(str(root / "dark.png"), other)
    (root / "empty.png").touch()
    result = run(root, tmp_path / "out")
    cause = "the photographs are almost black: the maximum of dark.png is 0 of 255"
    assert [each.partition(";")[0] for each in result.causes] == [f"photos: {cause}"]


def test_two_images_are_too_few_for_cameras_and_the_line_says_so(tmp_path, capsys):
    root = write(tmp_path / "photos", count=2)
    recipe = tmp_path / "one.toml"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 320 }]\n[scene]\n')
    options = ["--out", tmp_path / "out", "--recipe", recipe, "--workers", 0]
    assert run_command("reconstruct", root, *options) == 1
    line = "1 batch without cameras (at least three matched images are needed): photos"
    assert line in capsys.readouterr().out


def test_copies_of_one_photograph_are_named_as_the_cause(tmp_path, capsys):
    root = write(tmp_path / "photos", count=1)
    for name in ("a.png", "b.png"):
        (root / name).write_bytes((root / "0.png").read_bytes())
    recipe = tmp_path / "one.toml"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 320 }]\n[scene]\n')
    options = ["--out", tmp_path / "out", "--recipe", recipe, "--workers", 0]
    assert run_command("reconstruct", root, *options) == 1
    cause = "only 1 of 3 files can be read and is no copy of another; cameras need three different"
    assert f"photos: {cause}" in capsys.readouterr().out


def test_only_files_in_pairs_are_called_unreadable_or_copies(tmp_path):
    root = write_flat(tmp_path / "photos", FIRST)
    first, second, *_ = sorted(root.iterdir())
    copy = root / "copy.png"
    copy.write_bytes(second.read_bytes())
    result = run(root, tmp_path / "out", listed=[(first, second), (first, copy)])
    assert result.causes == (
        "photos: only 2 of 3 files in pairs can be read and are no copy of another; cameras need "
        "three different photographs",
    )
