"""Names of files and folders as they come: taken, passed over with a line, or refused; never a
traceback.
"""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.reconstruction import folder
from mkpc_kaggle.reconstruction.folder import (
    _without_twins,
    batch_names,
    pair_list_line,
    read_folder,
    read_pair_list,
)
from mkpc_kaggle.reconstruction.outputs import PlacedImage, submission_rows


def written(root: Path, *names: str) -> Path:
    for name in names:
        path = os.path.join(os.fsencode(root), os.fsencode(name))  # noqa: PTH118  a name may be no text
        os.makedirs(os.path.dirname(path), exist_ok=True)  # noqa: PTH103, PTH120
        with open(path, "wb"):  # noqa: PTH123
            pass
    return root


def names_of(root: Path) -> dict[str, list[str]]:
    return {name: [file.name for file in files] for name, files in read_folder(root).items()}


NO_TEXT = os.fsdecode(b"caf\xe9")


@pytest.mark.parametrize(
    "name", ["a\n.jpg", "a\x1b[2J.jpg", f"{NO_TEXT}.jpg", f"{NO_TEXT}/a.jpg", "x\ty/a.jpg"]
)
def test_names_that_are_no_text_are_refused_by_their_folder(tmp_path, name):
    with pytest.raises(UserError, match="has characters that are no text; rename it"):
        read_folder(written(tmp_path, "b.jpg", "c.jpg", name))


@pytest.mark.parametrize(
    "name", ["models", "work", "database.db", "a/models", "cameras.csv", "report.html", "Models"]
)
def test_folders_that_are_called_as_results_are_refused_at_once(tmp_path, name):
    with pytest.raises(UserError, match=r"results are called .*; rename that folder"):
        read_folder(written(tmp_path, f"{name}/0.png", f"{name}/1.png"))


def test_what_is_hidden_is_passed_over_with_a_line(tmp_path, capsys):
    root = written(
        tmp_path, "f0.jpg", "f1.jpg", "._f0.jpg", ".thumbnails/f0.jpg", "a/._x.jpg", ".DS_Store"
    )
    assert names_of(root) == {".": ["f0.jpg", "f1.jpg"]}
    assert (
        f"hidden files and folders are passed over: 3, the first is {root}"
        in capsys.readouterr().err
    )


def test_folders_are_datasets_also_through_links_and_links_that_go_round_end(tmp_path):
    root = written(tmp_path / "images", "x.jpg/1.png", "x.jpg/2.png", "a.png")
    written(tmp_path / "elsewhere", "1.png", "2.png")
    (root / "b").symlink_to(tmp_path / "elsewhere")
    (root / "x.jpg" / "round").symlink_to(root)
    assert names_of(root) == {".": ["a.png"], "b": ["1.png", "2.png"], "x.jpg": ["1.png", "2.png"]}


def test_names_in_a_list_of_pairs_may_have_blanks(tmp_path):
    root = written(tmp_path / "images", "a b.png", "c.png", "d e f.png")
    (tmp_path / "pairs.txt").write_text("a b.png c.png\n  d e f.png\ta b.png \r\n")
    found = read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))
    assert [(a.name, b.name) for a, b in found] == [("a b.png", "c.png"), ("a b.png", "d e f.png")]
    written(root, "a", "a.png", "a.png b.png", "b.png c.png")
    (tmp_path / "pairs.txt").write_text("a.png b.png c.png\n")
    # It can be read in two ways
    with pytest.raises(UserError, match="expected two images of one dataset"):
        read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))


def rows_of(root: Path, files: Iterable[str]) -> list[tuple[str, ...]]:
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3))
    placed = PlacedImage(0, camera)
    cameras = {}
    for name in files:
        path = root / name
        cameras.setdefault(path.parent.relative_to(root).as_posix(), {})[path] = placed
    _, *rows = submission_rows("imc2025", cameras, root)
    return [tuple(row) for row in rows]


def test_ids_and_rows_of_2025_are_unique(tmp_path):
    root = tmp_path / "a"
    rows = rows_of(root, ["b.jpg", "a/b.jpg", "a_b/c.jpg", "a/b_c.jpg", "a/b/c.jpg"])
    assert len({row[0] for row in rows}) == len(rows) == 5
    assert len({(row[1], row[3]) for row in rows}) == 5
    assert rows_of(root, ["x/1.png", "y/1.png"])[0][:2] == ("x_1.png", "x")
    assert np.all([row[2] == "cluster0" for row in rows])


def test_the_images_of_the_root_have_the_name_of_its_folder(tmp_path):
    root = tmp_path / "fountain"
    assert batch_names(root, [".", "inner"]) == {".": "fountain", "inner": "inner"}
    assert batch_names(root, [".", "fountain"]) == {".": "fountain_", "fountain": "fountain"}
    assert batch_names(Path("/"), ["."]) == {".": "images"}


def test_photographs_of_all_formats_that_are_decoded_are_taken(tmp_path, capsys):
    names = ["a.jpg", "b.jfif", "c.WEBP", "d.tif", "e.tiff", "f.bmp", "g.JPE", "h.ppm", "i.jp2"]
    assert names_of(written(tmp_path, *names, "notes.txt", "calibration.xml")) == {".": names}
    assert capsys.readouterr().err == ""


def test_photographs_that_cannot_be_read_are_counted_with_the_remedy(tmp_path, capsys):
    root = written(tmp_path, "0.jpg", "1.jpg", "2.HEIC", "3.heic", "a/4.dng", "a/5.jpg", ".x.heic")
    # A raw file next to its JPEG is no loss.
    written(tmp_path, "0.CR2", "1.heic")
    assert names_of(root) == {".": ["0.jpg", "1.jpg"], "a": ["5.jpg"]}
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "cannot be read" in line)
    assert "1 .dng, 2 .heic, the first is" in line
    assert f"{root}/2.HEIC; convert them to JPEG or PNG" in line


def test_a_folder_with_only_unread_formats_is_refused_with_the_remedy(tmp_path):
    with pytest.raises(UserError, match=r"has no images: .* must be converted first"):
        read_folder(written(tmp_path, "1.heic", "2.heic"))


def test_a_second_format_of_a_photograph_is_passed_over_with_a_line(tmp_path, capsys):
    root = written(tmp_path, "0.jpg", "0.webp", "1.png", "1.tif", "2.webp")
    assert names_of(root) == {".": ["0.jpg", "1.png", "2.webp"]}
    assert f"the same name: 2, the first is {root}/0.webp" in capsys.readouterr().err
    # Among the other formats, none is the usual one.
    with pytest.raises(UserError, match=r"has both 3\.tif and 3\.webp"):
        read_folder(written(root, "3.tif", "3.webp"))


def test_second_formats_take_time_in_proportion_to_their_number():
    looked_up = Counter()

    class Name(str):
        __slots__ = ()

        def __hash__(self) -> int:
            looked_up["names"] += 1
            return super().__hash__()

    count = 100
    files, twins = _without_twins(
        Name(f"{n}{suffix}") for suffix in (".jpg", ".webp") for n in range(count)
    )
    assert (len(files), len(twins)) == (count, count)
    assert looked_up["names"] < 10 * count


@pytest.mark.parametrize("folder", ["@eaDir/0.jpg", "#recycle", "$RECYCLE.BIN", "__MACOSX"])
def test_thumbnails_of_file_servers_are_passed_over_with_a_line(tmp_path, capsys, folder):
    root = written(tmp_path, "0.jpg", "1.jpg", f"{folder}/XL.jpg", f"{folder}/M.jpg")
    assert names_of(root) == {".": ["0.jpg", "1.jpg"]}
    assert f"are passed over: 1, the first is {root}/{folder[:5]}" in capsys.readouterr().err


def test_all_folders_can_be_one_dataset(tmp_path):
    root = written(tmp_path, "100/1.jpg", "100/2.jpg", "101/1.jpg", "models/3.jpg", "4.jpg")
    (name, files), *others = read_folder(root, join=True).items()
    assert (name, others) == (".", [])
    found = [file.relative_to(root).as_posix() for file in files]
    assert sorted(found) == ["100/1.jpg", "100/2.jpg", "101/1.jpg", "4.jpg", "models/3.jpg"]


def test_the_images_that_a_list_of_pairs_leaves_out_are_counted(tmp_path):
    root = written(tmp_path / "images", "a.png", "b.png", "c.png", "d.png")
    datasets = read_folder(root)
    (tmp_path / "pairs.txt").write_text("a.png b.png\na.png c.png\n")
    listed = read_pair_list(tmp_path / "pairs.txt", root, datasets)
    line = "--pairs: 2 pairs with 3 of 4 images; the first image without a pair is d.png"
    assert pair_list_line(listed, root, datasets) == line
    (tmp_path / "pairs.txt").write_text("a.png b.png\nd.png c.png\n")
    listed = read_pair_list(tmp_path / "pairs.txt", root, datasets)
    assert pair_list_line(listed, root, datasets) == "--pairs: 2 pairs with 4 of 4 images"


@pytest.mark.parametrize(
    ("line", "reason"),
    {
        "a.jpg c.jpg": "c.jpg is no image there; names are such as a.jpg",
        "a b": "a b is no image there",
        "a.jpg": "a name is no image there",
        "a.jpg a.jpg": "both are one image",
        "a.jpg sub/a.jpg": "separate datasets without --join",
    }.items(),
)
def test_a_line_of_a_list_that_names_no_pair_says_why(tmp_path, line, reason):
    root = written(tmp_path / "photos", "a.jpg", "b.jpg", "sub/a.jpg", "sub/b.jpg")
    path = tmp_path / "pairs.txt"
    path.write_text(f"a.jpg b.jpg\n{line}\n")
    datasets = read_folder(root)
    with pytest.raises(UserError, match=f"line 2: expected two images .*{reason}"):
        read_pair_list(path, root, datasets)
    path.write_text(f"a.jpg b.jpg\n{line}\nx y\n{line}\n")
    with pytest.raises(UserError, match=r"line 2: .*; 3 lines name no pair"):
        read_pair_list(path, root, datasets)


def test_comments_in_a_list_of_pairs_are_skipped_as_in_colmap(tmp_path):
    root = written(tmp_path / "photos", "a.jpg", "b.jpg", "#1.jpg")
    path = tmp_path / "pairs.txt"
    path.write_text("# of the tower\na.jpg b.jpg\n#1.jpg a.jpg\n")
    pairs = read_pair_list(path, root, read_folder(root))
    assert [[file.name for file in pair] for pair in pairs] == [
        ["a.jpg", "b.jpg"],
        ["#1.jpg", "a.jpg"],
    ]


STARTS = {
    "IMG_1": b"\xff\xd8\xff\xe0",
    "a.jpg_large": b"\xff\xd8\xff\xe1",
    "b.png.download": b"\x89PNG\r\n\x1a\n",
    "c.mpo": b"\xff\xd8\xff\xe1",
    "d.part": b"RIFF\0\0\0\0WEBP",
    "e": b"\0\0\0\x18ftypheic",
}


def test_photographs_without_a_known_suffix_are_counted_with_the_remedy(tmp_path, capsys):
    root = written(tmp_path / "photos", "x.jpg", "y.jpg", "notes.txt", "Thumbs.db")
    for name, start in STARTS.items():
        (root / name).write_bytes(start)
    # Backups of programs that change EXIF
    (root / "x.jpg_original").write_bytes(STARTS["IMG_1"])
    (root / "x.jpg.bak").write_bytes(STARTS["IMG_1"])
    assert names_of(root) == {".": ["x.jpg", "y.jpg"]}
    line = "photographs without a known suffix are not used: 6, the first is"
    assert f"{line} {root / 'IMG_1'}; give them the suffix" in capsys.readouterr().err
    for name in ("x.jpg", "y.jpg"):
        (root / name).unlink()
    with pytest.raises(UserError, match="photographs of other names must be renamed first"):
        read_folder(root)


def test_of_many_other_files_some_are_opened(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(folder, "MAX_OPENED", 2)
    root = written(tmp_path / "photos", "x.jpg", "y.jpg", "a.txt", "b.txt")
    (root / "c").write_bytes(STARTS["IMG_1"])
    read_folder(root)
    assert "suffix" not in capsys.readouterr().err


def test_a_line_with_several_readings_is_refused(tmp_path):
    names = ("x.jpg", "y.jpg y.jpg", "x.jpg y.jpg", "y.jpg")
    root = written(tmp_path / "photos", *names)
    path = tmp_path / "pairs.txt"
    path.write_text("x.jpg y.jpg y.jpg\n")
    with pytest.raises(UserError, match="its blanks allow several pairs"):
        read_pair_list(path, root, read_folder(root))
