"""Files that a command writes: whole or not at all, never over an input, without remains."""

import pytest

from mkpc_kaggle.data.outputs import replacing, require_apart


def test_an_earlier_submission_among_the_weights_is_replaced(tmp_path):
    (tmp_path / "s.csv").touch()
    require_apart({"--output": tmp_path / "s.csv"}, [tmp_path])


def test_no_file_remains_if_it_cannot_be_finished(tmp_path):
    with pytest.raises(RuntimeError), replacing(tmp_path / "submission.csv") as stream:
        stream.write("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_the_remains_of_a_killed_process_are_removed(tmp_path):
    kept = tmp_path / ".submission.csv.part"  # not ours
    for path in (tmp_path / ".submission.csv.0123abcd.part", kept):
        path.touch()
    with replacing(tmp_path / "submission.csv") as stream:
        stream.write("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [kept.name, "submission.csv"]
