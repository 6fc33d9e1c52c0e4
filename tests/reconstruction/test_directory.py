"""What lies in the directory of results: ours, in the way, or of datasets that are gone."""

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pycolmap
import pytest

from mkpc_kaggle.data.outputs import require_directory_apart
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction.directory import claim, settle
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.export import MODEL_FILES

FILES = ["database.db", *(f"models/0/{name}" for name in MODEL_FILES)]


def results(folder: Path, text: str = "made") -> None:
    for name in FILES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def files_of(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir())


def test_a_project_of_the_user_is_refused_and_stays(tmp_path):
    results(tmp_path / "out", "the user's")
    (tmp_path / "out" / "submission.csv").write_text("the user's")
    before = files_of(tmp_path)
    with pytest.raises(UserError, match=r"out/database.db is in the way, it was not made by this command"):
        claim(tmp_path / "out", ["."])
    assert files_of(tmp_path) == before


def test_a_directory_with_empty_folders_is_empty(tmp_path):
    (tmp_path / "out" / "work").mkdir(parents=True)
    assert claim(tmp_path / "out", ["."]) == []


def owned(out: Path) -> None:
    """A directory with results of two datasets and tables."""
    settle(out, ["a", "b"], claim(out, ["a", "b"]))
    for name in ("a", "b"):
        results(out / name)
    for name in ("cameras.csv", "submission.csv", "report.html", "work/journal.sqlite"):
        (out / name).write_text("made")


def test_results_of_an_earlier_run_are_ours_and_those_of_a_dataset_that_is_gone_are_removed(tmp_path):
    out = tmp_path / "out"
    owned(out)
    assert claim(out, ["a", "b"]) == []
    gone = claim(out, ["a", "c/d"])
    assert gone == ["b"]
    settle(out, ["a", "c/d"], gone)
    assert not (out / "b").exists()
    assert files_of(out / "a") == sorted(FILES)
    assert claim(out, ["a", "c/d"]) == []


def link(target: str) -> Callable[[Path], object]:
    return lambda path: path.symlink_to(target)


IN_THE_WAY: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a file of the user's": ("notes.txt", Path.touch),
    "a backup of a dataset": ("a.old", results),
    "a model that was exported": ("a/models/0/points.ply", Path.touch),
    "a database that is open": ("a/database.db-wal", Path.touch),
    "a link to the images for work": ("work", link("../images")),
    "a link to the images for models": ("a/models", link("../../images")),
    "a link for a dataset": ("b", link("../images")),
    "a link for the journal": ("work/journal.sqlite", link("../../images/a.png")),
    "a link for a table": ("cameras.csv", link("../images/a.png")),
    "a link for a database": ("a/database.db", link("../../images/a.png")),
    "a directory for a table": ("cameras.csv", Path.mkdir),
    "a directory for a database": ("a/database.db", Path.mkdir),
    "a file for models": ("a/models", Path.touch),
    "a pipe for a table": ("report.html", os.mkfifo),
}


@pytest.mark.parametrize("name", IN_THE_WAY)
def test_what_no_run_has_made_is_refused_by_its_name(tmp_path, name):
    out, (place, make) = tmp_path / "out", IN_THE_WAY[name]
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_text("image")
    owned(out)
    if (out / place).exists():
        (out / place).rename(tmp_path / "former")
    make(out / place)
    before = files_of(tmp_path)
    named = place.rstrip("/") if name != "a link to the images for work" else "work|cameras.csv|database.db"
    with pytest.raises(UserError, match=f"({named}).* is in the way"):
        claim(out, ["a", "b"])
    assert files_of(tmp_path) == before


def test_a_file_in_the_place_of_the_directory_is_refused(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(UserError, match="Not a directory"):
        claim(tmp_path / "out", ["."])


def test_a_place_that_cannot_be_written_is_found_before_any_work(tmp_path):
    with pytest.raises(UserError, match="cannot be written"):
        claim(tmp_path / "out", ["a" * 200 + "/" + "b" * 300])


@pytest.mark.parametrize("place", ["out/cameras.csv", "out", "out/a/pairs.txt"])
def test_nothing_that_is_read_lies_in_the_directory_of_results(tmp_path, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "a").mkdir(parents=True)
    if not Path(place).exists():
        Path(place).write_text("input")
    with pytest.raises(UserError, match="are in each other's way"):
        require_directory_apart(Path("out"), [Path(place)], [])
    with pytest.raises(UserError, match="are in each other's way"):
        require_directory_apart(Path("out"), [], [Path(place)])
    require_directory_apart(Path("out"), [Path("auto")], [])


def test_former_files_stay_until_the_new_ones_are_whole(tmp_path, monkeypatch):
    """A disk that is full while models are written costs neither the former models nor the former database."""
    results(tmp_path, "former")

    def write_half(folder: Path) -> None:
        (folder / "cameras.bin").write_text("half")
        raise OSError(28, "No space left on device")

    def write_whole(folder: Path) -> None:
        for name in MODEL_FILES:
            (folder / name).write_text("new")

    def write_files(write: Callable[[Path], None]) -> None:
        model = SimpleNamespace(images=(), colmap=SimpleNamespace(frames={}, write=write))
        colmap.write_files(tmp_path, None, None, {}, [model])  # type: ignore[arg-type,list-item]

    monkeypatch.setattr(colmap, "_fill", lambda *_: None)
    with pytest.raises(OSError, match="No space"):
        write_files(write_half)
    assert files_of(tmp_path) == sorted(FILES)
    assert {path.read_text() for path in tmp_path.rglob("*") if path.is_file()} == {"former"}
    synced = set()
    monkeypatch.setattr(os, "fsync", lambda number: synced.add(Path(f"/proc/self/fd/{number}").readlink().name))
    write_files(write_whole)
    assert synced == {"database.db", *MODEL_FILES}, "a power failure leaves no empty file under its name"
    assert files_of(tmp_path) == sorted(FILES)
    assert {(tmp_path / "models" / "0" / name).read_text() for name in MODEL_FILES} == {"new"}
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        assert database.num_images() == 0


def test_models_that_were_being_replaced_come_back(tmp_path):
    """A run that was killed between its two steps has the former models beside their place."""
    out = tmp_path / "out"
    owned(out)
    (out / "a" / ".new-1234").mkdir()
    (out / "a" / "models").rename(out / "a" / ".new-1234" / "former")
    settle(out, ["a", "b"], claim(out, ["a", "b"]))
    assert set(FILES) <= set(files_of(out / "a"))
