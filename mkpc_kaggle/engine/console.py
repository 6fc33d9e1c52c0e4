"""Printing during a run: lines, warnings, progress. It never raises or blocks the run.

A pipe without a reader or a stopped terminal (Ctrl-S) blocks a write forever, and with it every
thread that waits for the stream's lock. A lost terminal (EIO), a full disk or a closed stream makes
a write fail. So during a run each stream has a thread that writes, from a bounded queue. Native
libraries write to the descriptors directly: libjpeg and libpng print warnings while OpenCV decodes a
photograph. Their text goes to a file.
"""

import io
import logging
import multiprocessing
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NoReturn, TextIO

from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.progress import LINE_INTERVAL_S, WAIT_S, ProgressLine, format_duration, print_to

MAX_WAITING = 1000  # texts, which a busy progress line writes in a few minutes
# Of the text of native libraries, printed at the end: a warning for each photograph would hide the rest.
MAX_NATIVE_BYTES = 4096
CONSOLE_RETRY_S = 0.05  # between writes to a non-blocking descriptor that accepts no text
DRAIN_S = 2.0  # maximum wait at the end for the remaining text to be printed


class Console(logging.Handler):
    """Print records: warnings and errors on stderr after their level, others on stdout."""

    def handle(self, record: logging.LogRecord) -> bool:
        # Without logging's lock: a stream that blocks must not hold back the other.
        if self.filter(record):
            self.emit(record)
        return True

    def emit(self, record: logging.LogRecord) -> None:
        # Looked up for each record: notebooks, tests and :func:`unblocked` replace streams.
        if record.levelno < logging.WARNING:
            print_to(sys.stdout, record.getMessage())
        else:
            print_to(sys.stderr, f"{record.levelname.lower()}: {record.getMessage()}")


# The messages of the package; a program may give this logger other handlers.
logger = logging.getLogger("mkpc_kaggle")
logger.setLevel(logging.INFO)
logger.propagate = False
logger.addHandler(Console())


class Progress(ProgressLine):
    """Progress of a run: the pairs of a phase that are done, or how long a wait takes that has no
    count.
    """

    def __init__(self, budget: Budget, stream: TextIO | None) -> None:
        super().__init__(stream, budget.clock)
        self._budget = budget
        self._phase = ""
        self._first = 0  # pairs that were done when the phase began
        self._began = budget.clock()
        self.is_shown = stream is not None

    def count(self, phase: str, done: int, total: int) -> None:
        """Show the pairs that are done, after a job. A phase without pairs is not shown."""
        if not total:
            return
        now = self._budget.clock()
        # A phase that became smaller has no rate yet: fewer pairs are done than when it began.
        is_new = phase != self._phase or done < self._first
        if is_new:
            self._phase = phase
            self._first = done
            self._began = now
        text = self.meter(phase, done, total, now - self._began, "pair", first=self._first)
        if isfinite(self._budget.time_limit):
            text += f", budget left {format_duration(self._budget.left())}"
        self.show(text, is_new=is_new)

    def wait(self, text: str, since: float) -> None:
        """Show how long something takes that has no count. Short waits are not shown."""
        seconds = self._budget.clock() - since
        shortest = WAIT_S if self.is_redrawn else LINE_INTERVAL_S
        if seconds >= shortest and self.is_due:
            self._write(f"{text} [{format_duration(seconds)}]")


class QueuedFile(io.RawIOBase):
    """The binary file below a text stream, whose thread writes to ``descriptor`` from a bounded
    queue. Text is dropped if the queue is full.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._waiting: queue.Queue[bytes | None] = queue.Queue(MAX_WAITING)
        # Each stream has its own, because stdout and stderr may have different readers.
        threading.Thread(target=self._write_all, name="print", daemon=True).start()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        text = bytes(data)
        with suppress(queue.Full):  # without a reader for minutes
            self._waiting.put_nowait(text)
        return len(text)

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def fileno(self) -> int:
        return self._descriptor

    def drain(self, until: float) -> bool:
        """Wait until all text is printed, at most until ``until`` on the monotonic clock. Return
        whether it is.
        """
        while self._waiting.unfinished_tasks:
            if time.monotonic() >= until:
                return False
            time.sleep(0.002)
        return True

    def end(self) -> None:
        """End the thread, once all text is printed."""
        self._waiting.put_nowait(None)

    def _write_all(self) -> None:
        while (text := self._waiting.get()) is not None:
            with suppress(OSError):  # lost terminal, or full disk
                self._write_text(text)
            self._waiting.task_done()

    def _write_text(self, text: bytes) -> None:
        while text:
            try:
                text = text[os.write(self._descriptor, text) :]
            except BlockingIOError:  # the parent program has made the pipe non-blocking
                time.sleep(CONSOLE_RETRY_S)


_queued: dict[int, QueuedFile] = {}  # by descriptor; native libraries write to these descriptors


@contextmanager
def unblocked(descriptors: Sequence[int] = (1, 2)) -> Iterator[None]:
    """Print ``sys.stdout`` and ``sys.stderr`` by a thread, so that writes never block.

    Text of native libraries is printed at the end, or goes to the file of :func:`log_native`.
    Streams at other descriptors, such as a notebook's, are not changed.
    """
    occupy_standard_descriptors()
    with ExitStack() as ended:
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            number = _descriptor(stream)
            if number not in descriptors or number in _queued:
                continue
            stream.flush()
            sink = os.dup(number)  # the stream's file, once its number is taken by the other
            queued = QueuedFile(sink)
            text = io.TextIOWrapper(
                io.BufferedWriter(queued),
                stream.encoding,
                stream.errors,
                write_through=True,
                line_buffering=True,
            )
            setattr(sys, name, text)
            # From here on, native libraries write to a file, which never blocks.
            file = ended.enter_context(_native_file())
            os.dup2(file.fileno(), number)
            _queued[number] = queued
            ended.callback(_restore, name, stream, number, file)
        ended.callback(drain)
        yield


def _native_file() -> Any:
    """Open a file for the text of native libraries: a temporary file, or the null device where there
    is no directory for one.
    """
    try:
        return TemporaryFile()
    except OSError:  # a container in which only the output is writable, or a full disk
        return open(os.devnull, "w+b")  # noqa: PTH123


def _restore(name: str, stream: TextIO, number: int, file: Any) -> None:
    """Restore a stream and its descriptor, unless the file still blocks, since later writes would
    block, too.
    """
    queued = _queued.pop(number)
    setattr(sys, name, stream)
    file.seek(0)
    if text := file.read(MAX_NATIVE_BYTES):
        queued.write(text)
    if queued.drain(time.monotonic() + DRAIN_S / 10):
        with suppress(OSError):  # closed by the program
            os.dup2(queued.fileno(), number)
            os.close(queued.fileno())
        queued.end()


def occupy_standard_descriptors() -> None:
    """Open the null device at descriptors up to 2 that are closed: no other file may get their
    numbers.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            lowest = os.open(os.devnull, os.O_RDWR)  # this number, as those below are open
            os.set_inheritable(lowest, True)  # by worker processes


def log_native(path: Path) -> None:
    """Let native libraries write to a file from now on, while :func:`unblocked` is active."""
    with suppress(OSError):  # a full disk
        append_to(path, list(_queued))


def append_to(path: Path | str, descriptors: Sequence[int]) -> None:
    """Let these descriptors append to a file. Raise ``OSError`` if it cannot be opened."""
    if descriptors:
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        for number in descriptors:
            os.dup2(file, number)
        if file not in descriptors:
            os.close(file)


def drain(seconds: float = DRAIN_S) -> None:
    """Wait at most ``seconds`` until the remaining text is printed."""

    def flush() -> None:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            with suppress(OSError, ValueError):
                stream.flush()
        for queued in list(_queued.values()):
            queued.drain(until)

    until = time.monotonic() + seconds
    # In a thread, because flushing a blocked stream waits for its lock.
    thread = threading.Thread(target=flush, name="flush", daemon=True)
    thread.start()
    thread.join(seconds)


def leave(status: int, seconds: float = DRAIN_S) -> NoReturn:
    """End the process and its children, even if stopped (SIGSTOP). Print remaining text for up to
    ``seconds``.
    """
    # SIGKILL also ends stopped children, which would hold the terminal.
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


def _descriptor(stream: TextIO | None) -> int:
    """Return the descriptor of a stream whose writes can block, else -1."""
    with suppress(OSError, ValueError, AttributeError):
        return stream.fileno() if stream is not None and sys.platform != "win32" else -1
    return -1
