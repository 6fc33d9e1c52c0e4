"""The inputs of ``reconstruct``: a folder, a list of pairs, a table of known cameras."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction.folder import read_folder, read_intrinsics, read_pair_list


def written(root: Path, *names: str) -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return root


def test_photographs_of_all_subfolders_are_read_and_hidden_ones_are_not(tmp_path):
    names = ["b/1.JPG", "a.png", "b/c/2.webp", ".hidden/1.jpg", "._a.jpg", ".DS_Store"]
    root = written(tmp_path, *names)
    found = [file.relative_to(root).as_posix() for file in read_folder(root)]
    assert found == ["a.png", "b/1.JPG", "b/c/2.webp"]


def test_files_that_are_not_read_are_counted_in_one_line(tmp_path, capsys):
    root = written(
        tmp_path, "1.jpg", "2.jpg", "3.jpg", "4.heic", "5.HEIC", "README", "x/a.txt"
    )
    assert len(read_folder(root)) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("4 files not read: 2 .heic, 1 .txt, 1 no suffix")


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["1.jpg", "2.jpg"], "has 2 photographs"),
        (["1.jpg", "2.jpg", "a\nb.jpg"], "characters that are no text"),
    ],
)
def test_a_folder_that_cannot_be_reconstructed_is_refused(tmp_path, names, told):
    with pytest.raises(UserError, match=told):
        read_folder(written(tmp_path, *names))


def test_names_in_a_list_of_pairs_may_have_blanks(tmp_path):
    root = written(tmp_path / "images", "a b.png", "c.png", "d e f.png")
    text = "# a comment\n\na b.png c.png\n  d e f.png\ta b.png \r\nc.png a b.png\n"
    (tmp_path / "pairs.txt").write_text(text)
    found = read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))
    assert [(a.name, b.name) for a, b in found] == [
        ("a b.png", "c.png"),
        ("a b.png", "d e f.png"),
    ]


@pytest.mark.parametrize("line", ["a.png", "a.png a.png", "a.png d.png", ""])
def test_a_line_that_names_no_pair_is_refused(tmp_path, line):
    root = written(tmp_path / "images", "a.png", "b.png", "c.png")
    (tmp_path / "pairs.txt").write_text(f"{line}\n")
    with pytest.raises(UserError, match=r"does not name two images|has no pairs"):
        read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))


HEADS = "image,camera_model,width,height,parameters\n"


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    root = tmp_path / "images"
    (root / "drone").mkdir(parents=True)
    for name in ("a.png", "b.png", "drone/c.png"):
        cv2.imwrite(str(root / name), np.zeros((48, 64, 3), np.uint8))
    (root / "unreadable.png").touch()
    return root


def cameras_of(root: Path, rows: str) -> dict[str, tuple[str, tuple[float, ...]]]:
    table = root.parent / "known.csv"
    table.write_text(HEADS + rows)
    found = read_intrinsics(table, root, read_folder(root))
    return {name: (camera.model, camera.parameters) for name, camera in found}


def test_the_first_row_that_names_an_image_has_its_camera(photographs):
    rows = "a.png,PINHOLE,64,48,50 60 32 24\ndrone/*,SIMPLE_RADIAL,64,48,70 32 24 -0.1\n"
    rows += "*.png,SIMPLE_PINHOLE,64,48,80 30 20\n"
    assert cameras_of(photographs, rows) == {
        "a.png": ("PINHOLE", (50, 60, 32, 24)),
        "b.png": ("SIMPLE_PINHOLE", (80, 30, 20)),
        "drone/c.png": ("SIMPLE_RADIAL", (70, 32, 24, -0.1)),
        "unreadable.png": ("SIMPLE_PINHOLE", (80, 30, 20)),
    }


@pytest.mark.parametrize(
    ("row", "told"),
    [
        (
            "a.png,PINHOLE,128,96,100 100 64 48",
            "the row is for 128 x 96, and a.png has 64 x 48",
        ),
        ("a.png,SIMPLE_PINHOLE,64,48,4.2 32 24", "no focal length of a.png"),
        ("a.png,SIMPLE_PINHOLE,64,48,50 32", "SIMPLE_PINHOLE has 3 parameters"),
        ("a.png,SIMPLE_PINHOLE,64,48,nan 32 24", "is not finite"),
        ("a.png,UNKNOWN,64,48,50 32 24", "unknown camera model"),
        ("x.png,SIMPLE_PINHOLE,64,48,50 32 24", "'x.png' names no image"),
        ("", "has no rows"),
    ],
)
def test_a_row_that_does_not_fit_its_image_is_refused(photographs, row, told):
    with pytest.raises(UserError, match=told):
        cameras_of(photographs, f"{row}\n")
