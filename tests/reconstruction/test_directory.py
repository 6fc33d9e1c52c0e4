"""The output directory: what is refused, what is removed, and what is left alone."""

import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction.directory import MARK, output_directory, require_directory_apart
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.export import (
    MODEL_FILES,
    HeldDirectory,
    remove_files,
    remove_parts,
    versions_of,
)

WITHOUT_RECORDS = "\0" * 8  # a file of a model, whose count of records is 0
FILES = ["database.db", *(f"models/0/{name}" for name in MODEL_FILES)]
TABLES = ["cameras.csv", "report.html", "submission.csv"]


def write(folder: Path, names: list[str], text: str = "made") -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def files_of(folder: Path) -> dict[str, str]:
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name != "results.json"]
    return {
        path.relative_to(folder).as_posix(): path.read_text(errors="replace")
        for path in sorted(paths)
    }


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """What a run has made of two datasets; and an image of the user's next to it."""
    # Two datasets, called a and b
    with output_directory(tmp_path / "out", "ab", "imc2025"):
        for name in "ab":
            write(tmp_path / "out" / name, FILES)
        write(tmp_path / "out", [*TABLES, "work/journal.sqlite"])
    write(tmp_path / "images", ["a.png"], "image")
    return tmp_path / "out"


IN_THE_WAY = {
    "a folder for a file of a model": ("a/models/0/images.bin", Path.mkdir),
    "a file for a model": ("a/models/1", Path.touch),
    "an open database": ("a/database.db-wal", Path.touch),
    "a dataset's file that no run has made": (
        "c/database.db",
        lambda path: write(path.parent, [path.name]),
    ),
    "a link for work": ("work", lambda path: path.symlink_to("../images")),
    "a link for a dataset": ("b", lambda path: path.symlink_to("../images")),
    "a pipe for a table": ("report.html", os.mkfifo),
}


@pytest.mark.parametrize("name", IN_THE_WAY)
def test_a_link_or_a_file_of_the_users_in_the_place_of_a_result_is_refused(tmp_path, out, name):
    place, make = IN_THE_WAY[name]
    if (out / place).exists():
        (out / place).rename(tmp_path / "former")
    make(out / place)
    before = files_of(tmp_path)
    told = "is in the way" if place == "work" else f"{place}.* is in the way"
    with pytest.raises(UserError, match=told), output_directory(out, "abc", "imc2025"):
        raise AssertionError
    assert files_of(tmp_path) == before


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """A database in OUT that a run has made, in SQLite's mode of COLMAP."""
    path = tmp_path / "out" / "database.db"
    with output_directory(tmp_path / "out", ["."]), closing(sqlite3.connect(path)) as made:
        made.execute("PRAGMA journal_mode=WAL")
        made.execute("CREATE TABLE images (name TEXT)")
    return path


KILLED_READER = """
import os, sqlite3, sys
sqlite3.connect(sys.argv[1]).execute("SELECT count(*) FROM images").fetchall()
os.kill(os.getpid(), 9)
"""


def test_a_reader_that_was_killed_does_not_block_the_directory(database):
    before = database.read_bytes()
    subprocess.run([sys.executable, "-c", KILLED_READER, database], check=False)
    assert [path.name for path in database.parent.glob("database.db-*")], "as a kill leaves them"
    with output_directory(database.parent, ["."]):
        pass
    assert [*database.parent.glob("database.db-*")] == []
    assert database.read_bytes() == before


def test_a_database_that_another_program_has_open_is_refused_with_the_remedy(database):
    with closing(sqlite3.connect(database)) as reader:
        reader.execute("SELECT count(*) FROM images").fetchall()
        told = r"another program has .*database\.db open, .*; close that program"
        with pytest.raises(UserError, match=told), output_directory(database.parent, ["."]):
            raise AssertionError
    with output_directory(database.parent, ["."]):
        pass


def test_files_of_others_next_to_models_are_in_nobodys_way(out):
    # Gaussian splatting writes the first one.
    others = ["a/sparse/0/points3D.ply", "a/models/notes.txt", "a/models/0/dense/fused.ply"]
    with output_directory(out, "ab", "imc2025"):
        write(out, [f"a/sparse/0/{name}" for name in MODEL_FILES])
    write(out, others, "the user's")
    for datasets in ("ab", "b", "b"):
        with output_directory(out, datasets, "imc2025"):
            pass
        assert {files_of(out)[name] for name in others} == {"the user's"}
    # The dataset is gone, and our files with it.
    left = [name for name in files_of(out) if name.startswith("a/")]
    assert left == sorted(others)


def test_nothing_is_written_or_removed_in_another_directory_that_has_the_name_now(out, tmp_path):
    write(tmp_path / "project", ["submission.csv", "b/database.db"])
    before = files_of(tmp_path / "project")
    with output_directory(out, ["a"]) as held:
        out.rename(tmp_path / "moved")
        out.symlink_to("project")
        with pytest.raises(OSError, match="moved or replaced"):
            held.check()
    assert files_of(tmp_path / "project") == before
    assert not (tmp_path / "project" / "work").exists()


@pytest.mark.parametrize(
    "name", ["notes.txt", "work/journal.sqlite", "work/results.json", "database.db", "link"]
)
def test_a_directory_that_is_neither_empty_nor_ours_is_refused(tmp_path, name):
    write(tmp_path / "out", [name])
    # A link is not followed: it may lead anywhere.
    if name == "link":
        (tmp_path / "out" / "link").unlink()
        (tmp_path / "out" / "link").symlink_to(tmp_path)
    told = rf"out/{name} is in the way, it was not made by this command"
    with pytest.raises(UserError, match=told), output_directory(tmp_path / "out", ["."]):
        raise AssertionError


def test_results_that_only_earlier_runs_made_are_removed_when_the_run_has_ended(out, capsys):
    # Next to results, and in a hidden folder that looks like one of ours
    write(out, ["notes.txt", "a/notes.txt", ".new-1/mine"], "the user's")
    with output_directory(out, ["a"]):
        assert (out / "b" / "database.db").exists()
        write(out / "a", FILES, "made again")
    found = files_of(out)
    assert {name for name in found if name.startswith("b") or name == "submission.csv"} == set()
    assert {found[name] for name in ("notes.txt", "a/notes.txt", ".new-1/mine")} == {"the user's"}
    assert not (out / "b").exists()
    assert f"{out / 'submission.csv'} was removed" in capsys.readouterr().err
    with output_directory(out, "c"):
        pass
    assert sorted(path.name for path in (out / "a").iterdir()) == ["notes.txt"], "of both runs"


def test_a_result_that_the_user_has_changed_is_not_removed(out):
    changed = ["submission.csv", "b/models/0/images.bin"]
    # After the run, which knows the digests of its results
    write(out, changed, "the user's")
    for datasets, form in (("ab", "imc2025"), ("a", None), ("a", None)):
        with output_directory(out, datasets, form):
            pass
    found = files_of(out)
    assert {found[name] for name in changed} == {"the user's"}
    assert "b/database.db" not in found


@pytest.mark.parametrize("name", ["../images/database.db", "{}/images/database.db"])
def test_a_name_in_a_mark_never_leads_out_of_the_directory(tmp_path, out, name):
    write(tmp_path / "images", ["database.db"])
    # Somebody has written another path into our mark.
    marked = json.loads((out / MARK).read_text())
    (out / MARK).write_text(json.dumps(marked | {name.format(tmp_path): marked["a/database.db"]}))
    with output_directory(out, "ab", "imc2025"):
        pass
    assert (tmp_path / "images" / "database.db").exists()


@pytest.mark.parametrize(
    ("out", "datasets"),
    [("file", ["."]), ("pipe", ["."]), ("loop", ["."]), ("out", ["a" * 200 + "/" + "b" * 300])],
)
def test_a_directory_that_cannot_be_written_is_found_before_any_work(tmp_path, out, datasets):
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    # A link to itself leads nowhere.
    (tmp_path / "loop").symlink_to("loop")
    with (
        pytest.raises(UserError, match="cannot be written"),
        output_directory(tmp_path / out, datasets),
    ):
        raise AssertionError


@pytest.mark.parametrize("place", ["out/cameras.csv", "out", "out/a/pairs.txt"])
def test_nothing_that_is_read_lies_in_the_directory_of_results(tmp_path, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "a").mkdir(parents=True)
    if not Path(place).exists():
        Path(place).write_text("input")
    with pytest.raises(UserError, match="contains, or lies in, the input"):
        require_directory_apart(Path("out"), [Path(place)], [])
    with pytest.raises(UserError, match="contains, or lies in, the input"):
        require_directory_apart(Path("out"), [], [Path(place)])
    # The name of a recipe is no path.
    require_directory_apart(Path("out"), [Path("auto")], [])


def test_new_models_leave_files_of_others_where_they_are(tmp_path, monkeypatch):
    others = ["models/0/thesis.txt", "models/3/mine/notes.txt", "models/0/points3D.ply"]
    write(tmp_path, FILES + [f"models/1/{name}" for name in MODEL_FILES])
    monkeypatch.setattr(colmap, "_fill", lambda *_, **__: None)

    def fill(folder: Path) -> None:
        write(folder, [*MODEL_FILES], WITHOUT_RECORDS)
        write(tmp_path, others, "the user's")  # during the run

    model = SimpleNamespace(images=(), colmap=SimpleNamespace(frames={}, write=fill))
    (tmp_path / "models" / "0").joinpath("link").symlink_to("thesis.txt")
    held = HeldDirectory.of(tmp_path)
    colmap.write_files(held, None, {}, [model])
    found = files_of(tmp_path)
    assert {found[name] for name in others} == {"the user's"}
    assert (tmp_path / "models" / "0" / "link").readlink() == Path("thesis.txt")
    assert {name for name in found if name.startswith("models/1")} == set(), "a former model"
    assert found["models/0/images.bin"] == WITHOUT_RECORDS
    # A run without cameras
    remove_files(held, versions_of(tmp_path))
    assert sorted(files_of(tmp_path)) == sorted([*others, "models/0/link"])


def test_only_files_that_the_run_began_with_are_removed_and_only_in_its_own_directory(tmp_path):
    out = tmp_path / "out"
    write(out, FILES)
    held = HeldDirectory.of(out)
    former = versions_of(out)
    write(out, ["models/0/images.bin", "sparse/0/images.bin"], "the user's now")
    out.rename(tmp_path / "moved")
    write(out, FILES, "the user's")
    assert not remove_files(held, former)
    assert set(files_of(out).values()) == {"the user's"}
    (tmp_path / "out").rename(tmp_path / "project")
    (tmp_path / "moved").rename(out)
    assert remove_files(held, former)
    assert sorted(files_of(out)) == ["models/0/images.bin", "sparse/0/images.bin"]


def test_a_killed_process_leaves_no_folder_and_loses_no_file_of_others(tmp_path):
    left = tmp_path / ".mkpc-new-1"
    companions = ["database.db-wal", "database.db-shm"]
    write(left, [*FILES, *companions, "former/0/images.bin", "former/0/thesis.txt"])
    write(left, ["images/undistorted.jpg"])
    remove_parts(tmp_path)
    assert sorted(files_of(left)) == ["former/0/thesis.txt"]
    (left / "former" / "0" / "thesis.txt").unlink()
    remove_parts(tmp_path)
    assert not left.exists()


def test_former_files_stay_until_the_new_ones_are_whole(tmp_path, monkeypatch):
    """A disk that is full while models are written costs neither the former models nor the former
    database.
    """
    write(tmp_path, FILES, "former")

    def write_files(names: Sequence[str] = MODEL_FILES, text: str = WITHOUT_RECORDS) -> None:
        def fill(folder: Path) -> None:
            write(folder, [*names], text)
            if len(names) < len(MODEL_FILES):
                raise OSError(28, "No space left on device")

        model = SimpleNamespace(images=(), colmap=SimpleNamespace(frames={}, write=fill))
        colmap.write_files(HeldDirectory.of(tmp_path), None, {}, [model])

    monkeypatch.setattr(colmap, "_fill", lambda *_, **__: None)
    with pytest.raises(OSError, match="No space"):
        write_files(MODEL_FILES[:1])
    # pycolmap itself reports nothing.
    with pytest.raises(OSError, match="No space"):
        write_files(text="cut")
    assert files_of(tmp_path) == dict.fromkeys(FILES, "former")
    # Links of /proc name the files that are synced.
    synced = set()
    monkeypatch.setattr(
        os, "fsync", lambda number: synced.add(Path(f"/proc/self/fd/{number}").readlink().name)
    )
    write_files()
    assert synced == {"database.db", *MODEL_FILES}, (
        "a power failure leaves no empty file under its name"
    )
    texts = {(tmp_path / "models" / "0" / name).read_text() for name in MODEL_FILES}
    assert texts == {WITHOUT_RECORDS}
