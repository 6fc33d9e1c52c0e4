"""Bars of waits outside of a run."""

import pytest

from mkpc_kaggle import progress


@pytest.mark.parametrize(("silence", "is_shown"), [(0.0, True), (60.0, False)])
def test_long_waits_are_counted_and_short_ones_print_nothing(
    monkeypatch, capsys, silence, is_shown
):
    monkeypatch.setattr(progress, "MAX_SILENCE_S", silence)
    assert list(progress.counted("abc", "letters", "letter")) == ["a", "b", "c"]
    assert ("letters:" in capsys.readouterr().err) == is_shown
