"""Files that a command writes: whole or not at all, never over an input, and nothing is left beside them."""

import os
from contextlib import nullcontext
from pathlib import Path

import pytest

from mkpc_kaggle.data.outputs import replacing, require_apart
from mkpc_kaggle.errors import UserError


@pytest.fixture
def place(tmp_path):
    """Inputs: a table, a directory with an image, a directory with a weight file and an earlier submission."""
    for name in ("test.csv", "images/x.png", "weights/m.pth", "weights/s.csv"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious")
    (tmp_path / "link.csv").symlink_to("test.csv")
    (tmp_path / "hard.csv").hardlink_to(tmp_path / "test.csv")
    return tmp_path


@pytest.mark.parametrize(
    ("option", "name", "says"),
    [
        ("--output", "test.csv", "would be written over the input"),
        ("--output", "link.csv", "would be written over the input"),
        ("--output", "hard.csv", "would be written over the input"),
        ("--json", "images/x.png", "would be written over the input"),
        ("--json", "submission.csv", "exists and is not a .json file"),
        ("--report", "submission.csv", "exists and is not a .html file"),
        ("--output", "weights/s.csv", ""),
        ("--output", "n" * 300, ""),
    ],
)
def test_an_input_is_never_overwritten_and_a_result_only_by_its_own_kind(place, option, name, says):
    (place / "submission.csv").touch()
    with pytest.raises(UserError, match=says) if says else nullcontext():
        require_apart({option: place / name}, [place / "test.csv", place / "images", place / "weights"])


def test_nothing_is_left_of_a_file_that_cannot_be_finished(tmp_path):
    with pytest.raises(RuntimeError), replacing(tmp_path / "submission.csv") as stream:
        stream.write("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_has_left_is_removed(tmp_path):
    kept = tmp_path / ".submission.csv.part"  # not ours
    for path in (tmp_path / ".submission.csv.0123abcd.part", kept):
        path.touch()
    with replacing(tmp_path / "submission.csv") as stream:
        stream.write("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [kept.name, "submission.csv"]


def test_a_device_is_written_to_and_not_replaced():
    ours, terminal = os.openpty()
    try:
        with replacing(Path(os.ttyname(terminal))) as stream:
            stream.write("all of it")
        assert os.read(ours, 100) == b"all of it"
    finally:
        os.close(ours)
        os.close(terminal)
