"""Progress of a wait: a line that is drawn again on a terminal, and printed now and then elsewhere."""

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from math import inf
from typing import TextIO, TypeVar

LINE_INTERVAL_S = 30.0  # between lines where a line cannot be redrawn in place
REDRAW_S = 0.2  # between redraws: a reader sees no more, and a terminal may be slow
MAX_SILENCE_S = 1.0  # before a bar on a terminal: shorter waits need none
WAIT_S = 5.0  # before a line that stays
ERASE = "\r\x1b[K"  # moves a terminal's cursor to the start of the line, and clears the line
# Parts of tqdm's meter; a bar of ten ASCII characters, since a terminal may know no others
COUNT = "{desc}: {n_fmt}/{total_fmt}"
BAR = " |{bar:10a}|"
PACE = " [{elapsed}<{remaining}, {rate_fmt}]"

Item = TypeVar("Item")


def format_duration(seconds: float) -> str:
    """Return text such as ``8h45m``, ``12m03s`` or ``4.2s``."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"


class ProgressLine:
    """The progress line of a stream. ``None`` is no stream: nothing is shown."""

    def __init__(self, stream: TextIO | None, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        # A notebook's `!command` has a terminal, but Jupyter stores every state of a redrawn line. It
        # sets JPY_PARENT_PID for these processes.
        self.is_redrawn = is_terminal(stream) and "JPY_PARENT_PID" not in os.environ
        self._text = ""  # that is not shown yet
        self._is_drawn = False  # a text is on the terminal's last line
        self._shown = -inf

    def show(self, text: str, *, is_new: bool = False) -> None:
        """Replace the text: at once if ``is_new``, otherwise after an interval."""
        if is_new and self.is_redrawn:
            self.close()  # the former text stays, on the line above
        self._text = text
        if is_new or self.is_due:
            self._write(text)
            self._text = ""

    @property
    def is_due(self) -> bool:
        """Whether the latest text has been there for the interval."""
        interval = REDRAW_S if self.is_redrawn else LINE_INTERVAL_S
        return self._clock() - self._shown >= interval

    def note(self, text: str) -> None:
        """Print a line that stays."""
        self._erase()
        print_to(self._stream, text)

    def close(self) -> None:
        """Show the latest text, which stays."""
        if self._text:
            self._write(self._text)
            self._text = ""
        if self._is_drawn:
            print_to(self._stream, "")
            self._is_drawn = False

    def remove(self) -> None:
        """Drop the text, and erase it on a terminal."""
        self._text = ""
        self._erase()

    def _write(self, text: str) -> None:
        if self.is_redrawn:
            # A wrapped line could not be erased. The width may change at any time.
            width = shutil.get_terminal_size().columns
            print_to(self._stream, ERASE + text[: width - 1], end="")
            self._is_drawn = True
        else:
            print_to(self._stream, text)
        self._shown = self._clock()

    def _erase(self) -> None:
        if self._is_drawn:
            print_to(self._stream, ERASE, end="")
            self._is_drawn = False

    def meter(
        self, what: str, done: int, total: int, seconds: float, unit: str, first: int = 0
    ) -> str:
        """Return text such as ``sweep: 84/304 [02:10<05:40, 1.55s/pair]``, on a terminal with a bar.

        The ``first`` items were done before these seconds, and say nothing about the rate. The
        times are left out as long as no rate is known.
        """
        from tqdm import tqdm  # most commands do not need it

        count = done - first
        rate = count / seconds if count and seconds else None
        bar_format = COUNT + (BAR if self.is_redrawn else "")
        if rate is not None:
            bar_format += PACE
        return tqdm.format_meter(
            done, total, seconds, prefix=what, unit=unit, rate=rate, bar_format=bar_format
        )


def counted(items: Sequence[Item], what: str, unit: str) -> Generator[Item, None, None]:
    """Yield the items and show how many are done, with the rate and the remaining time."""
    line = ProgressLine(sys.stderr)
    silence = MAX_SILENCE_S if line.is_redrawn else WAIT_S
    began = time.monotonic()

    def show(done: int) -> None:
        seconds = time.monotonic() - began
        if seconds >= silence:
            line.show(line.meter(what, done, len(items), seconds, unit))

    try:
        # The first item may take a minute.
        with _after(silence, lambda: show(0)) as timer:
            for done, item in enumerate(items):
                if done:
                    timer.cancel()
                show(done)
                yield item
    finally:
        line.remove()


@contextmanager
def announced(text: str) -> Iterator[None]:
    """Print a line if the block takes long and has nothing to count."""
    with _after(WAIT_S, lambda: print_to(sys.stderr, text)):
        yield


@contextmanager
def _after(seconds: float, show: Callable[[], None]) -> Iterator[threading.Timer]:
    """Call ``show`` in a thread if the block takes longer than this."""
    timer = threading.Timer(seconds, show)
    timer.daemon = True  # a terminal that accepts no text must not keep the program alive
    timer.start()
    try:
        yield timer
    finally:
        timer.cancel()


def print_to(stream: TextIO | None, text: str, end: str = "\n") -> None:
    """Print a text if that is possible; ``None`` is no stream."""
    with suppress(OSError, ValueError):  # lost terminal, full disk, or closed stream
        if stream is not None:
            print(text, file=stream, flush=True, end=end)


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream writes to a terminal, directly or through a printing thread."""
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # a closed stream
        return False
