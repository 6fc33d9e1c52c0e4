"""The only place that prints during a run: lines, warnings, progress. It never raises.

A terminal may disappear (EIO), a pipe lose its reader, a disk fill up, or a stream be closed from the start. The
run continues, and its files record its events. During a run, printing never waits either: see
:mod:`mkpc_kaggle.engine.streams`.
"""

import multiprocessing
import os
import sys
from contextlib import suppress
from math import isfinite
from typing import NoReturn, TextIO

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.streams import DRAIN_S, drain, is_terminal

LINE_INTERVAL_S = 30.0  # between lines of progress where a line cannot be drawn again


def say(text: str) -> None:
    _print(text, sys.stdout)


def warn(text: str) -> None:
    _print(f"warning: {text}", sys.stderr)


def complain(text: str) -> None:
    _print(f"error: {text}", sys.stderr)


def _print(text: str, stream: TextIO | None, end: str = "\n") -> None:
    with suppress(OSError, ValueError):  # gone, full, or closed
        if stream is not None:
            print(text, file=stream, flush=True, end=end)


def leave(status: int, seconds: float = DRAIN_S) -> NoReturn:
    """End the process and its children, even stopped ones (SIGSTOP). Printing the rest may take ``seconds``."""
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


class Progress:
    """Progress of a phase in pairs: a line that is drawn again in place on a terminal, occasional lines elsewhere.

    The children of a notebook's kernel (``!command``) have a terminal whose text is stored, each state of a line
    with it. Jupyter marks them with JPY_PARENT_PID.
    """

    def __init__(self, budget: Budget, stream: TextIO | None) -> None:
        self._budget, self._stream = budget, stream
        self._erase = "\r\x1b[K" if is_terminal(stream) and "JPY_PARENT_PID" not in os.environ else ""
        self._phase = self._line = ""
        self._written = budget.clock()

    def show(self, phase: str, done: int, total: int) -> None:
        """Show progress after a job. A phase without pairs is not shown."""
        if not total:
            return
        began, self._phase = phase != self._phase, phase
        if began and self._erase:
            self.close()
        count = f"{total} pairs" if began else f"{done} of {total} pairs"
        left = f", budget left {format_duration(self._budget.left())}" if isfinite(self._budget.time_limit) else ""
        self._line = f"{phase}: {count}{left}"
        if self._erase:
            _print(self._erase + self._line, self._stream, end="")
        elif began or self._budget.clock() - self._written >= LINE_INTERVAL_S:
            self.close()

    def note(self, text: str) -> None:
        _print(self._erase + text, self._stream)
        self._line = "" if self._erase else self._line

    def close(self) -> None:
        """End the line on a terminal, or print the pending line."""
        if self._line:
            _print("" if self._erase else self._line, self._stream)
            self._line, self._written = "", self._budget.clock()
