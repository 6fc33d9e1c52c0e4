"""Printing during a run: lines, warnings, progress. It never raises or blocks the run.

A pipe without a reader or a stopped terminal (Ctrl-S) blocks a write forever, and with it every
thread that waits for the stream's lock. A lost terminal (EIO), a full disk or a closed stream makes
a write fail. So one thread prints, from a bounded queue. Native libraries write to the descriptors
directly: libjpeg and libpng print warnings while OpenCV decodes a photograph. Their text goes to a
file.
"""

import io
import multiprocessing
import os
import queue
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NoReturn, TextIO

from mkpc_kaggle.engine.plan.budget import Budget, format_duration
from mkpc_kaggle.progress import LINE_INTERVAL_S, WAIT_S, ProgressLine, print_to

MAX_WAITING = 1000  # writes, which a busy progress line makes in a few minutes
# Of the text of native libraries, printed at the end: a warning for each photograph would hide the rest.
MAX_NATIVE_BYTES = 4096
RETRY_S = 0.05  # between looks at a descriptor that accepts no text
DRAIN_S = 2.0  # maximum wait at the end for the remaining text to be printed


def say(text: str) -> None:
    print_to(sys.stdout, text)


def warn(text: str) -> None:
    print_to(sys.stderr, f"warning: {text}")


def complain(text: str) -> None:
    print_to(sys.stderr, f"error: {text}")


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


class Printer:
    """The printing thread, with a bounded queue of (descriptor, bytes). Text is dropped if the
    queue is full.
    """

    def __init__(self) -> None:
        self._waiting: queue.Queue[tuple[int, bytes]] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._print, name="print", daemon=True)
        self._thread.start()

    def put(self, descriptor: int, data: bytes) -> None:
        with suppress(queue.Full):  # without a reader for minutes
            self._waiting.put_nowait((descriptor, data))

    def drain(self, until: float) -> bool:
        """Wait until all text is printed, at most until ``until`` on the monotonic clock. Return
        whether it is.
        """
        while self._waiting.unfinished_tasks:
            if time.monotonic() >= until:
                return False
            time.sleep(0.002)
        return True

    def _print(self) -> None:
        # By descriptor, because stdout and stderr may have different readers.
        pending: dict[int, deque[bytes]] = {}
        while True:
            with suppress(queue.Empty):
                # Look again from time to time whether a blocked descriptor accepts text.
                descriptor, data = self._waiting.get(timeout=RETRY_S if pending else None)
                pending.setdefault(descriptor, deque()).append(data)
            for descriptor in list(pending):
                self._write(descriptor, pending[descriptor])
                if not pending[descriptor]:
                    del pending[descriptor]

    def _write(self, descriptor: int, texts: deque[bytes]) -> None:
        """Write and remove texts until the descriptor would block: a reader of stderr that does not
        read must not hold back stdout.
        """
        while texts and (len(texts) > MAX_WAITING or _accepts(descriptor)):
            data = texts.popleft()
            rest = b""
            if len(texts) < MAX_WAITING:  # else the oldest text is dropped
                with suppress(OSError):  # lost terminal, or full disk
                    # A pipe that accepts text has room for PIPE_BUF bytes, and perhaps not for more.
                    rest = data[os.write(descriptor, data[: select.PIPE_BUF]) :]
            if rest:
                texts.appendleft(rest)
            else:
                self._waiting.task_done()


def _accepts(descriptor: int) -> bool:
    """Return whether a write of up to ``PIPE_BUF`` bytes does not block; also if it would fail."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(0))


class Queued(io.RawIOBase):
    """The binary file below a text stream whose text the printing thread prints to ``descriptor``."""

    def __init__(self, descriptor: int, printer: Printer) -> None:
        self._descriptor = descriptor
        self._printer = printer

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        text = bytes(data)
        self._printer.put(self._descriptor, text)
        return len(text)

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def fileno(self) -> int:
        return self._descriptor


_printer: Printer | None = None  # of this process, once something is printed by it
_native: list[int] = []  # descriptors that native libraries write to, while streams are queued


@contextmanager
def unblocked(descriptors: Sequence[int] = (1, 2)) -> Iterator[None]:
    """Print ``sys.stdout`` and ``sys.stderr`` by a thread, so that writes never block.

    Text of native libraries is printed at the end, or goes to the file of :func:`log_native`.
    Streams at other descriptors, such as a notebook's, are not changed.
    """
    global _printer  # noqa: PLW0603  one thread for the process
    occupy_standard_descriptors()
    with ExitStack() as ended:
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            number = _descriptor(stream)
            if number not in descriptors or number in _native:
                continue
            _printer = _printer or Printer()
            stream.flush()
            sink = os.dup(number)  # the stream's file, once its number is taken by the other
            raw = io.BufferedWriter(Queued(sink, _printer))
            queued = io.TextIOWrapper(
                raw, stream.encoding, stream.errors, write_through=True, line_buffering=True
            )
            setattr(sys, name, queued)
            # From here on, native libraries write to a file, which never blocks.
            file = ended.enter_context(_native_file())
            os.dup2(file.fileno(), number)
            _native.append(number)
            ended.callback(_restore, name, stream, number, sink, file)
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


def _restore(name: str, stream: TextIO, number: int, sink: int, file: Any) -> None:
    """Restore a stream and its descriptor, unless the file still blocks, since later writes would
    block, too.
    """
    assert _printer is not None
    setattr(sys, name, stream)
    file.seek(0)
    if text := file.read(MAX_NATIVE_BYTES):
        _printer.put(sink, text)
    if _printer.drain(time.monotonic() + DRAIN_S / 10):
        with suppress(OSError):  # closed by the program
            os.dup2(sink, number)
            os.close(sink)
    _native.remove(number)


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
        append_to(path, _native)


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
        if _printer is not None:
            _printer.drain(until)

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
