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
from typing import Any, NoReturn, TextIO

from tqdm import tqdm

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.streams import DRAIN_S, columns, drain

LINE_INTERVAL_S = 30.0  # between lines of progress where a bar cannot be drawn again


def say(text: str) -> None:
    _print(text, sys.stdout)


def warn(text: str) -> None:
    _print(f"warning: {text}", sys.stderr)


def complain(text: str) -> None:
    _print(f"error: {text}", sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    with suppress(OSError, ValueError):  # gone, full, or closed
        if stream is not None:
            print(text, file=stream, flush=True)


def leave(status: int, seconds: float = DRAIN_S) -> NoReturn:
    """End the process and its children, even stopped ones (SIGSTOP). Printing the rest may take ``seconds``."""
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


class Progress:
    """Progress of a phase in pairs (``unit``): a bar on a terminal, occasional lines elsewhere.

    The children of a notebook's kernel (``!command``) have a terminal whose text is stored, each state of a bar
    with it. Jupyter marks them with JPY_PARENT_PID.
    """

    def __init__(self, budget: Budget, stream: TextIO | None, unit: str = "pair") -> None:
        self._budget, self._stream, self._unit = budget, stream, unit
        self._columns = columns(stream) if stream is not None and "JPY_PARENT_PID" not in os.environ else 0
        self._bar: tqdm[Any] | None = None
        self._phase = self._waiting = ""
        self._written = budget.clock()

    def show(self, phase: str, done: int, total: int) -> None:
        """Show progress after a job. A phase without pairs is not shown."""
        if self._stream is None or not total:
            return
        began, self._phase = phase != self._phase, phase
        left = f"budget left {format_duration(self._budget.left())}" if isfinite(self._budget.time_limit) else ""
        if self._columns:
            with suppress(OSError, ValueError):
                self._draw(phase if began else "", done, total, left)
            return
        count = f"{total} {self._unit}s" if began else f"{done} of {total} {self._unit}s"
        self._waiting = ", ".join(filter(None, [f"{phase}: {count}", left]))
        if began or self._budget.clock() - self._written >= LINE_INTERVAL_S:
            self.close()

    def note(self, text: str) -> None:
        with suppress(OSError, ValueError):
            if self._stream is not None:
                tqdm.write(text, file=self._stream)  # a bar continues below it

    def close(self) -> None:
        """End the bar, or print the pending line."""
        with suppress(OSError, ValueError):
            if self._bar is not None:
                self._bar.close()
        self._bar = None
        if self._waiting:
            _print(self._waiting, self._stream)
            self._waiting, self._written = "", self._budget.clock()

    def _draw(self, began: str, done: int, total: int, left: str) -> None:
        if began:
            self.close()
            # With a delay, nothing is drawn before the bar is whole: a dead terminal left half a bar.
            width = self._columns
            self._bar = tqdm(total=total, desc=began, unit=self._unit, file=self._stream, ncols=width, delay=1e-9)
        if self._bar is not None:
            self._bar.set_postfix_str(left, refresh=False)
            self._bar.update(done - self._bar.n)
