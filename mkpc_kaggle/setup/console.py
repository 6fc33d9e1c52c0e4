"""Messages by logging: lines for the user, the progress of a run, and its log file.

A terminal without a reader (Ctrl-S) blocks a write forever. So a run prints from a bounded queue
(:func:`queued`): a blocked terminal costs lines, and not the run.
"""

import logging
import multiprocessing
import os
import queue
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from logging.handlers import QueueHandler, QueueListener
from math import inf, isfinite
from pathlib import Path
from typing import Any, NoReturn

from mkpc_kaggle.progress import (
    LINE_INTERVAL_S,
    REDRAW_S,
    format_duration,
    is_terminal,
    print_to,
)

LOG_NAME = "run.log"  # in the work directory
MAX_WAITING = 1000  # lines, which a progress line writes in a few minutes
DRAIN_S = 2.0  # maximum wait at the end for the remaining lines to be printed


class Console(logging.Handler):
    """Print records: warnings and errors on stderr after their level, a state of the progress on stderr as
    it is, others on stdout.
    """

    def __init__(self) -> None:
        super().__init__(logging.INFO)

    def emit(self, record: logging.LogRecord) -> None:
        # Looked up for each record, because notebooks and tests replace streams.
        text = record.getMessage()
        if hasattr(record, "progress"):
            print_to(sys.stderr, text, end="")
        elif record.levelno < logging.WARNING:
            print_to(sys.stdout, text)
        else:
            print_to(sys.stderr, f"{record.levelname.lower()}: {text}")


class Dropping(QueueHandler):
    """Put records into a bounded queue, or drop them if it is full: nobody has read for minutes."""

    def __init__(self) -> None:
        self.waiting: queue.Queue[Any] = queue.Queue(MAX_WAITING)
        super().__init__(self.waiting)
        self.setLevel(logging.INFO)

    def enqueue(self, record: logging.LogRecord) -> None:
        with suppress(queue.Full):
            self.waiting.put_nowait(record)


class LogFile(logging.FileHandler):
    """A file of all records with their times, also of those of level DEBUG, which are for it alone."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        self.addFilter(lambda record: not hasattr(record, "progress"))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Lose the line: the disk is full."""


# The messages of the package; a program may give this logger other handlers.
logger = logging.getLogger("mkpc_kaggle")
logger.setLevel(logging.DEBUG)
logger.propagate = False
logger.addHandler(Console())


@contextmanager
def queued() -> Iterator[None]:
    """Let a thread print from a queue, so that no call of the logger blocks."""
    dropping = Dropping()
    handlers = logger.handlers
    listener = QueueListener(dropping.waiting, *handlers)
    logger.handlers = [dropping]
    listener.start()
    try:
        yield
    finally:
        # Otherwise the thread is blocked, and stays behind.
        if drain():
            listener.stop()
        logger.handlers = handlers


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """Append the messages to a log file, if it can be written."""
    try:
        handler = LogFile(path)
    except OSError:
        yield
        return
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        with suppress(OSError):  # a full disk
            handler.close()


def drain(seconds: float = DRAIN_S) -> bool:
    """Wait at most ``seconds`` until all lines are printed. Return whether they are."""
    until = time.monotonic() + seconds
    for handler in logger.handlers:
        while isinstance(handler, Dropping) and handler.waiting.unfinished_tasks:
            if time.monotonic() >= until:
                return False
            time.sleep(0.002)
    return True


def leave(status: int, seconds: float = DRAIN_S) -> NoReturn:
    """End the process and its children, even if stopped (SIGSTOP). Print remaining lines for up to
    ``seconds``.
    """
    # SIGKILL also ends stopped children, which would hold the terminal.
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


class Progress:
    """The progress of a run on stderr: a count on a line that is drawn again; a line every half minute where
    lines stay.
    """

    def __init__(
        self, left: Callable[[], float] = lambda: inf, *, is_shown: bool = True
    ) -> None:
        self._left = left  # seconds of the run
        self._is_shown = is_shown
        self._bar: Any = None
        self._phase = ""  # that was logged last
        # A notebook's `!command` has a terminal, but Jupyter keeps every state of a line. It sets
        # JPY_PARENT_PID for these processes.
        self._is_redrawn = is_terminal(sys.stderr) and "JPY_PARENT_PID" not in os.environ

    def count(self, phase: str, done: int, total: int, unit: str) -> None:
        """Show the units that are done in a phase. Other units, or fewer than before, have a line of
        their own. A change of phase is a line of the log.
        """
        if phase != self._phase:
            self._phase = phase
            logger.debug(phase)
        if not self._is_shown or not total:
            return
        bar = self._bar
        if bar is None or bar.unit != unit or done < bar.n or total != bar.total:
            from tqdm import tqdm  # most commands do not need it

            self.close()
            tqdm.monitor_interval = 0  # without a thread of its own
            interval = REDRAW_S if self._is_redrawn else LINE_INTERVAL_S
            self._bar = bar = tqdm(
                desc=phase,
                initial=done,
                total=total,
                unit=unit,
                ascii=True,
                file=self,
                mininterval=interval,
                ncols=None if self._is_redrawn else 80,
            )
        bar.set_description(phase, refresh=False)
        if isfinite(left := self._left()):
            bar.set_postfix_str(f"budget left {format_duration(left)}", refresh=False)
        bar.update(done - bar.n)

    def note(self, text: str) -> None:
        """Print a line that stays, and log it."""
        logger.debug(text)
        if self._is_shown:
            self.write(f"\r{text}\n")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    # The file that tqdm writes to

    def write(self, text: str) -> None:
        if not self._is_redrawn:
            text = f"{line}\n" if (line := text.strip()) else ""
        if text:
            logger.info("%s", text, extra={"progress": True})

    def flush(self) -> None:
        """Each record is flushed."""

    def fileno(self) -> int:
        """Return the descriptor whose width tqdm asks for."""
        return sys.stderr.fileno()
