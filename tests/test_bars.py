"""Bars of waits outside of a run: redrawn on a terminal, lines elsewhere."""

import os
import sys
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
    assert b"letters: 0/3 |          | [" in shown
    assert shown.endswith(b"\r\x1b[K"), "the bar is erased at the end"


def test_a_notebook_and_a_file_get_lines(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.0)
    assert list(progress.counted("abc", "letters", "letter")) == ["a", "b", "c"]
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" [")[0] for line in lines] == [
        "letters: 0/3",
        "letters: 1/3",
        "letters: 2/3",
    ]


def test_short_waits_print_nothing(capsys):
    list(progress.counted("abc", "letters", "letter"))
    assert capsys.readouterr() == ("", "")
