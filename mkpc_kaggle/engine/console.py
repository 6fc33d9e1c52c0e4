"""The only place that prints during a run: lines, warnings, progress. It never raises.

A terminal may go away (EIO), a pipe lose its reader, a disk be full, or a stream be closed from the start: the run
goes on, and its files tell what happened.
"""

import multiprocessing
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from typing import Any, NoReturn, TextIO

from tqdm import tqdm

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


def _print(text: str, stream: TextIO | None) -> None:
    with suppress(OSError, ValueError):  # gone, full, or closed
        if stream is not None:
            print(text, file=stream, flush=True)


def leave(status: int) -> NoReturn:
    """End the process at once, and its children, one that was stopped (SIGSTOP) among them."""
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
    state of a bar would be stored and, in Kaggle's log, printed. Jupyter marks them with JPY_PARENT_PID.
    """
    return stream.isatty() and "JPY_PARENT_PID" not in os.environ


class Progress:
    """How many pairs of the present pass are done: a bar on a terminal, a line now and then anywhere else."""

    def __init__(self, budget: Budget, stream: TextIO | None = None) -> None:
        self._budget = budget
        self._stream = stream or sys.stderr
        self._phase = ""
        self._bar: tqdm[Any] | None = None
        self._waiting = ""
        self._written = budget.clock()

    def show(self, phase: str, done: int, total: int) -> None:
        """Called after every job."""
        self._guarded(lambda: self._show(phase, done, total))

    def close(self) -> None:
        """End the bar, or write the line that waits."""
        self._guarded(self._close)

    def _show(self, phase: str, done: int, total: int) -> None:
        left = f"budget left {format_duration(self._budget.left())}" if isfinite(self._budget.time_limit) else ""
        began, self._phase = phase != self._phase, phase
        if redraws(self._stream):
            if began:
                self._close()
                self._bar = tqdm(total=total, desc=phase, unit="pair", file=self._stream)
            assert self._bar is not None
            self._bar.set_postfix_str(left, refresh=False)
            self._bar.update(done - self._bar.n)
            return
        count = f"{total} pairs" if began else f"{done} of {total} pairs"
        self._waiting = ", ".join(filter(None, [f"{phase}: {count}", left]))
        if began or self._budget.clock() - self._written >= LINE_INTERVAL_S:
            self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._waiting:
            line, self._waiting, self._written = self._waiting, "", self._budget.clock()
            print(line, file=self._stream, flush=True)

    def _guarded(self, draw: Callable[[], None]) -> None:
        """Draw, or never again if that fails."""
        if self._stream is None:
            return
        try:
            draw()
        except (OSError, ValueError):
            self._stream = self._bar = None
