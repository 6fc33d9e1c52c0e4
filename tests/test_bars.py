"""Bars of waits outside of a run: redrawn on a terminal, lines elsewhere."""

import os
import sys
import time
from contextlib import suppress
from pathlib import Path

from mkpc_kaggle import progress


def test_a_terminal_shows_a_bar_even_if_it_states_no_size(monkeypatch):
    ours, theirs = os.openpty()
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    monkeypatch.setattr(progress, "MAX_SILENCE_S", 0.0)
    with Path(os.ttyname(theirs)).open("w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stream)
        assert list(progress.counted("abc", "letters", "letter")) == ["a", "b", "c"]
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # all is read, since the other side is closed
        while True:
            shown += os.read(ours, 1000)
    os.close(ours)
    assert b"letters: 0/3 |          |" in shown
    assert b"?" not in shown, "a rate that is not known"
    assert shown.endswith(b"\r\x1b[K"), "the bar is erased at the end"


def test_a_notebook_and_a_file_get_lines(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.0)
    monkeypatch.setattr(progress, "WAIT_S", 0.0)
    assert list(progress.counted("abc", "letters", "letter")) == ["a", "b", "c"]
    lines = capsys.readouterr().err.splitlines()
    counts = [line.partition(" [")[0] for line in lines]
    # The count of the first item may come from the loop or from the timer.
    assert sorted(set(counts)) == ["letters: 0/3", "letters: 1/3", "letters: 2/3"]


def test_a_file_gets_a_line_before_the_end_of_a_long_first_item(monkeypatch, tmp_path):
    monkeypatch.setattr(progress, "WAIT_S", 0.01)
    written = tmp_path / "stderr"
    with written.open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        for _ in progress.counted(["a"], "letters", "letter"):
            wait_for_a_line(written)
    assert written.read_text() == "letters: 0/1\n"


def test_a_wait_without_a_count_has_a_line(monkeypatch, tmp_path):
    monkeypatch.setattr(progress, "WAIT_S", 0.0)
    written = tmp_path / "stderr"
    with written.open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        with progress.announced("loading"):
            wait_for_a_line(written)
    assert written.read_text() == "loading\n"


def wait_for_a_line(file: Path) -> None:
    until = time.monotonic() + 20.0
    while not file.read_text() and time.monotonic() < until:
        time.sleep(0.01)


def test_short_waits_print_nothing(capsys):
    list(progress.counted("abc", "letters", "letter"))
    with progress.announced("loading"):
        pass
    assert capsys.readouterr() == ("", "")
