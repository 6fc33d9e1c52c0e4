"""The only place that prints during a run: lines, warnings, progress. It never raises.

A terminal may go away (EIO), a pipe lose its reader, a disk be full, or a stream be closed from the start: the run
goes on, and its files tell what happened.
"""

import multiprocessing
import os
import sys
from contextlib import suppress
from math import isfinite
from typing import NoReturn, TextIO

from mkpc_kaggle.engine.budget import Budget, format_duration

LINE_INTERVAL_S = 30.0  # between lines of progress where a line cannot be drawn again


def say(text: str) -> None:
    """Print lines for the user to standard output."""
    _print(text, sys.stdout)


def warn(text: str) -> None:
    """Print a warning to standard error."""
    _print(f"warning: {text}", sys.stderr)


def complain(text: str) -> None:
    """Print an error to standard error."""
    _print(f"error: {text}", sys.stderr)


def _print(text: str, stream: TextIO | None, end: str = "\n") -> None:
    with suppress(OSError, ValueError):  # gone, full, or closed
        if stream is not None:
            print(text, file=stream, flush=True, end=end)


def leave(status: int) -> NoReturn:
    """End the process at once, and its children, stopped ones (SIGSTOP) too."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.flush()
    for child in multiprocessing.active_children():
        child.kill()
    os._exit(status)


def redraws(stream: TextIO) -> bool:
    """Whether a line on the stream can be drawn again.

    The children of a notebook's kernel (``!command``) are given a terminal, but what they write is kept: every
    state of a line would be stored and, in Kaggle's log, printed. Jupyter marks them with JPY_PARENT_PID.
    """
    return stream.isatty() and "JPY_PARENT_PID" not in os.environ


class Progress:
    """How many pairs of a phase are done: a line drawn again on a terminal, printed now and then anywhere else."""

    def __init__(self, budget: Budget, stream: TextIO | None = None) -> None:
        self._budget = budget
        self._stream = stream or sys.stderr
        self._redraws = self._stream is not None and redraws(self._stream)
        self._phase = self._waiting = ""
        self._written = budget.clock()

    def show(self, phase: str, done: int, total: int) -> None:
        """Called after every job; a phase without pairs is not told."""
        if not total:
            return
        began, self._phase = phase != self._phase, phase
        if began and self._redraws:
            self.close()
        self._waiting = f"{phase}: {total} pairs" if began else f"{phase}: {done} of {total} pairs"
        if isfinite(self._budget.time_limit):
            self._waiting += f", budget left {format_duration(self._budget.left())}"
        if self._redraws:
            _print(f"\r{self._waiting}\x1b[K", self._stream, end="")
        elif began or self._budget.clock() - self._written >= LINE_INTERVAL_S:
            self.close()

    def close(self) -> None:
        """End the line on a terminal, or print the line that waits."""
        if self._waiting:
            _print("" if self._redraws else self._waiting, self._stream)
            self._waiting, self._written = "", self._budget.clock()
