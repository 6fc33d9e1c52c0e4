"""The last files of the command: a failing disk costs its own file, not the summary and the report."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from shared import run_command, write_small_recipe

from mkpc_kaggle.cli import reconstruct
from mkpc_kaggle.reconstruction import coordinates, export, layout
from mkpc_kaggle.scene.align import REFERENCE

FULL = OSError(28, "No space left on device")


@pytest.fixture(scope="module", autouse=True)
def without_drawings() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(sys.modules, "matplotlib", None)
        yield


@pytest.fixture(scope="module")
def home(demo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs in ``images`` and a recipe, with the results of a run in ``out``."""
    home = tmp_path_factory.mktemp("last")
    recipe = write_small_recipe(home)
    # The matches at 320 and 400 pixels are too few with some versions of OpenCV
    recipe.write_text(recipe.read_text().replace("320", "480").replace("400", "640"))
    recipe.rename(home / "recipe.toml")
    shutil.copytree(demo.train_dir / "courtyard" / "images", home / "images")
    assert run_command(*command(home)) == 0
    return home


def command(home: Path) -> list[object]:
    options = ["--recipe", home / "recipe.toml", "--workers", 0]
    return ["reconstruct", home / "images", "--out", home / "out", *options]


def refuse(*_: object) -> None:
    raise FULL


def no_memory(*_: object) -> None:
    raise MemoryError


FAILING = {
    "sparse": (layout, "write_images", "sparse was not written: OSError: [Errno 28] No space left"),
    "coordinates": (coordinates, "write_reference", "json cannot be written: No space left"),
    "export": (export, "write_hloc", "matches.h5 cannot be written: No space left"),
}


@pytest.mark.parametrize("name", FAILING)
def test_a_file_that_cannot_be_written_is_a_line_and_the_exit_status(
    home, monkeypatch, capsys, name
):
    module, function, words = FAILING[name]
    # Without h5py
    monkeypatch.setattr(reconstruct, "require_h5py", lambda: None)
    monkeypatch.setattr(export, "write_hloc", lambda path, *_: path.touch())
    monkeypatch.setattr(module, function, refuse)
    report = home / "out" / "report.html"
    report.unlink()
    export_to = home / "matches.h5"
    assert run_command(*command(home), "--export", export_to) == 1
    said = capsys.readouterr().out
    assert words in said
    assert "with a camera" in said
    assert report.exists()
    # The others were written.
    assert export_to.exists() == (name != "export")
    export_to.unlink(missing_ok=True)


def test_an_error_without_a_text_is_a_failure_of_sparse(monkeypatch):
    sent = []
    monkeypatch.setattr(layout, "convert_models", no_memory)
    # Its own process ignores Ctrl-C, and this one must not.
    monkeypatch.setattr(layout.signal, "signal", lambda *_: None)
    layout._write_sparse_to(type("Sender", (), {"send": sent.append}), None, {})
    (failure,) = sent
    assert failure.startswith("MemoryError")


def test_a_refused_command_keeps_the_coordinates_in_spite_of_fresh(home, capsys):
    before = (home / "out" / REFERENCE).read_bytes()
    words = [word if word != home / "recipe.toml" else "nosuch" for word in command(home)]
    assert run_command(*words, "--fresh") == 2
    assert "nosuch" in capsys.readouterr().err
    assert (home / "out" / REFERENCE).read_bytes() == before
