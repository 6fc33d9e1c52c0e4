"""Progress: a line drawn again on a terminal, few lines where every line stays."""

from io import StringIO

import pytest
from simulator import VirtualClock

from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.progress import LINE_INTERVAL_S


class Terminal(StringIO):
    pass


@pytest.fixture(autouse=True)
def no_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    is_terminal = lambda stream: isinstance(stream, Terminal)  # noqa: E731
    monkeypatch.setattr("mkpc_kaggle.progress.is_terminal", is_terminal)


def test_a_terminal_has_a_line_for_each_phase() -> None:
    stream = Terminal()
    clock = VirtualClock()
    progress = Progress(Budget(0.0, 100.0, clock), stream)
    progress.count("sweep", 8, 8)
    for done in (1, 2):
        progress.count("deepen", done, 8)
        clock.now = 10.0
    progress.close()
    shown = [line.split("\r\x1b[K")[-1] for line in stream.getvalue().split("\n")[:-1]]
    assert shown == [
        "sweep: 8/8 |##########|, budget left 1m38s",
        "deepen: 2/8 |##5       | [00:10<01:00, 10.00s/pair], budget left 1m28s",
    ]


def test_a_bar_shows_a_rate_and_a_remaining_time_once_they_are_known() -> None:
    stream = StringIO()
    clock = VirtualClock()
    progress = Progress(Budget(0.0, clock=clock), stream)
    # Resumed pairs: they took no time of this run.
    progress.count("sweep", 40, 50)
    clock.now += LINE_INTERVAL_S
    progress.count("sweep", 43, 50)
    lines = stream.getvalue().splitlines()
    assert lines == ["sweep: 40/50", "sweep: 43/50 [00:30<01:10, 10.00s/pair]"]


def test_the_terminal_that_a_notebook_gives_its_commands_has_lines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    stream = Terminal()
    Progress(Budget(0.0, clock=VirtualClock()), stream).count("sweep", 1, 5)
    assert stream.getvalue() == "sweep: 1/5\n"


def test_a_file_gets_lines_when_a_phase_begins_every_half_minute_and_at_the_end() -> None:
    stream = StringIO()
    clock = VirtualClock()
    progress = Progress(Budget(0.0, clock=clock), stream)
    for done in range(1, 101):  # 100 seconds
        clock.now += 1
        progress.count("sweep", done, 100)
    progress.count("deepen", 1, 2)
    clock.now += LINE_INTERVAL_S - 1
    progress.count("deepen", 2, 2)
    progress.close()
    progress.close()
    times = [
        "31/100 [00:30<01:09,  1.00pair/s]",
        "61/100 [01:00<00:39,  1.00pair/s]",
        "91/100 [01:30<00:09,  1.00pair/s]",
    ]
    deepen = ["deepen: 1/2", "deepen: 2/2 [00:29<00:00, 29.00s/pair]"]
    sweep = ["sweep: 1/100", *(f"sweep: {text}" for text in times)]
    assert stream.getvalue().splitlines() == [*sweep, *deepen]


def test_a_wait_is_counted_on_a_terminal_and_a_line_now_and_then_elsewhere() -> None:
    terminal = Terminal()
    file = StringIO()
    clock = VirtualClock()
    shown = [Progress(Budget(0.0, clock=clock), stream) for stream in (terminal, file)]
    for _ in range(70):
        for progress in shown:
            progress.wait("batch a: reconstructing its cameras, about 1m10s", 0.0)
        clock.now += 1
    assert terminal.getvalue().count("\r\x1b[K") == 65, "the first five seconds are not shown"
    assert terminal.getvalue().split("\r\x1b[K")[-1] == (
        "batch a: reconstructing its cameras, about 1m10s [1m09s]"
    )
    assert [line[-7:] for line in file.getvalue().splitlines()] == ["[30.0s]", "[1m00s]"]
    for progress in shown:
        progress.count("sweep", 1, 2)
        progress.close()
    assert terminal.getvalue().splitlines()[-1].endswith("sweep: 1/2 |#####     |")


@pytest.mark.parametrize("stream", [StringIO(), Terminal()])
def test_a_note_is_a_line_of_its_own(stream: StringIO) -> None:
    progress = Progress(Budget(0.0, clock=VirtualClock()), stream)
    progress.count("sweep", 1, 5)
    progress.note("batch one: 4 of 4 images with a camera")
    progress.close()
    assert "batch one: 4 of 4 images with a camera\n" in stream.getvalue()


def test_a_phase_that_becomes_smaller_has_no_negative_rate() -> None:
    stream = StringIO()
    clock = VirtualClock()
    progress = Progress(Budget(0.0, clock=clock), stream)
    # Fewer extra pairs fit in the time: those that were counted as done are no part of it.
    for done, total in ((40, 60), (24, 24), (25, 30)):
        progress.count("connect", done, total)
        clock.now += LINE_INTERVAL_S
    progress.close()
    assert stream.getvalue().splitlines() == [
        "connect: 40/60",
        "connect: 24/24",
        "connect: 25/30 [00:30<02:30, 30.00s/pair]",
    ]
