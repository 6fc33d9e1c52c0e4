"""How far the present pass of a run is: a bar on a terminal, a line now and then anywhere else."""

import os
from contextlib import suppress
from math import isfinite
from typing import Any, Protocol, TextIO

from tqdm import tqdm

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.jobs import Phase

LINE_SECONDS = 30.0


class Progress(Protocol):
    """Updated after every job how many pairs of the present pass are done."""

    def show(self, phase: Phase, done: int, total: int) -> None: ...

    def close(self) -> None: ...


def progress_on(stream: TextIO, budget: Budget) -> Progress:
    """A bar where the stream redraws a line; where every line stays, few of them."""
    return Bar(stream, budget) if redraws(stream) else Lines(stream, budget)


def redraws(stream: TextIO) -> bool:
    """Whether a line on the stream can be written over.

    The children of a notebook's kernel (``!command``) are given a terminal, but what they write is kept: every
    state of a bar would be stored and, in Kaggle's log, printed. Jupyter marks them with JPY_PARENT_PID.
    """
    return stream.isatty() and "JPY_PARENT_PID" not in os.environ


class Bar:
    """A bar that is drawn anew in its place."""

    def __init__(self, stream: TextIO, budget: Budget) -> None:
        self._stream = stream
        self._budget = budget
        self._bar: tqdm[Any] | None = None
        self._phase: Phase | None = None

    def show(self, phase: Phase, done: int, total: int) -> None:
        if phase is not self._phase:
            self.close()
            self._bar, self._phase = tqdm(total=total, desc=phase, unit="pair", file=self._stream), phase
        assert self._bar is not None
        if isfinite(self._budget.limit):
            self._bar.set_postfix_str(f"budget left {format_duration(self._budget.left())}", refresh=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


class Lines:
    """A line when a pass begins, every :data:`LINE_SECONDS` of the budget's clock, and in the end.

    A pass begins when the one before is done, so that no line need say so.
    """

    def __init__(self, stream: TextIO, budget: Budget) -> None:
        self._stream = stream
        self._budget = budget
        self._phase: Phase | None = None
        self._waiting = ""
        self._written = budget.clock()

    def show(self, phase: Phase, done: int, total: int) -> None:
        began = phase is not self._phase
        self._phase = phase
        left = f", budget left {format_duration(self._budget.left())}" if isfinite(self._budget.limit) else ""
        # A pass is opened while jobs of the one before are out: what it has done means little yet.
        self._waiting = f"{phase}: {total} pairs{left}" if began else f"{phase}: {done} of {total} pairs{left}"
        if began or self._budget.clock() - self._written >= LINE_SECONDS:
            self.close()

    def close(self) -> None:
        """Write the line that waits, if there is one."""
        if self._waiting:
            with suppress(OSError):  # the reader of the log may have left; the run goes on
                print(self._waiting, file=self._stream, flush=True)
            self._waiting, self._written = "", self._budget.clock()
