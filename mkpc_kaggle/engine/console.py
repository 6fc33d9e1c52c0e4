"""The only module that prints during a run: lines, warnings, progress. Printing never raises or blocks the run.

A pipe without a reader or a stopped terminal (Ctrl-S) blocks a write forever, and with it every thread that waits
for the stream's lock. A lost terminal (EIO), a full disk or a closed stream makes a write fail. Native libraries
write to the descriptors directly: libjpeg and libpng print warnings while OpenCV decodes a photograph. So threads
relay all output to descriptors 1 and 2, in the program and in worker processes.
"""

import multiprocessing
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import isfinite
from typing import NoReturn, TextIO

from mkpc_kaggle.engine.budget import Budget, format_duration

LINE_INTERVAL_S = 30.0  # between lines of progress if a line cannot be redrawn in place
MAX_WAITING = 1000  # writes, which a busy progress line makes in a few minutes
MAX_BYTES = 4096  # per read
DRAIN_S = 2.0  # maximum wait at the end for the remaining text to be printed


def say(text: str) -> None:
    _print(text, sys.stdout)


def warn(text: str) -> None:
    _print(f"warning: {text}", sys.stderr)


def complain(text: str) -> None:
    _print(f"error: {text}", sys.stderr)


def _print(text: str, stream: TextIO | None, end: str = "\n") -> None:
    with suppress(OSError, ValueError):  # lost terminal, full disk, or closed stream
        if stream is not None:
            print(text, file=stream, flush=True, end=end)


class Progress:
    """Progress of a phase in pairs: a line redrawn in place on a terminal, occasional lines elsewhere.

    A notebook's ``!command`` has a terminal, but Jupyter stores all its text, including every state of a redrawn
    line. Jupyter sets JPY_PARENT_PID for these processes.
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
        """End the redrawn line on a terminal, or print the pending line elsewhere."""
        if self._line:
            _print("" if self._erase else self._line, self._stream)
            self._line, self._written = "", self._budget.clock()


@contextmanager
def unblocked(descriptors: Sequence[int] = (1, 2)) -> Iterator[None]:
    """Relay ``sys.stdout`` and ``sys.stderr``, so that writes never block. Print the remaining text at the end.

    Streams at other descriptors, such as a notebook's, are not changed.
    """
    with ExitStack() as ended:
        for stream in (sys.stdout, sys.stderr):
            number = _descriptor(stream)
            if number in descriptors and number not in _relays:
                stream.flush()
                _relays[number] = Relay(number)
                ended.callback(_relays[number].close)
        ended.callback(drain)
        yield


def drain(seconds: float = DRAIN_S) -> None:
    """Wait at most ``seconds`` until the remaining text is printed."""

    def flush() -> None:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            with suppress(OSError, ValueError):
                stream.flush()
        for relay in list(_relays.values()):
            relay.drain(until)

    until = time.monotonic() + seconds
    thread = threading.Thread(target=flush, name="flush", daemon=True)
    thread.start()
    thread.join(seconds)


def leave(status: int, seconds: float = DRAIN_S) -> NoReturn:
    """End the process and its children, even if stopped (SIGSTOP). Print remaining text for up to ``seconds``."""
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream writes to a terminal, directly or through a relay."""
    descriptor = _descriptor(stream)
    return os.isatty(_relays[descriptor].sink if descriptor in _relays else descriptor)


def _descriptor(stream: TextIO | None) -> int:
    """Return the descriptor of a stream whose writes can block, else -1."""
    with suppress(OSError, ValueError, AttributeError):
        return stream.fileno() if stream is not None and sys.platform != "win32" else -1
    return -1


class Relay:
    """A relay from a descriptor to its original file, ``sink``: one thread reads, another prints.

    Text is dropped if the queue between the threads is full, or if the file refuses the write.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self.sink = descriptor, os.dup(descriptor)
        self._source, pipe = os.pipe()
        os.dup2(pipe, descriptor)
        os.close(pipe)
        self._reading = threading.Lock()
        self._waiting: queue.Queue[bytes] = queue.Queue(MAX_WAITING)
        for work in (self._read, self._print):
            threading.Thread(target=work, name=f"relay {descriptor}", daemon=True).start()

    def drain(self, until: float) -> bool:
        """Wait until all text is printed, at most until ``until`` on the monotonic clock. Return whether it is."""
        while time.monotonic() < until:
            with self._reading:
                if not select.select([self._source], [], [], 0)[0] and not self._waiting.unfinished_tasks:
                    return True
            time.sleep(0.002)
        return False

    def close(self) -> None:
        """Restore the descriptor's file, unless the file still blocks, since later writes would block, too."""
        if self.drain(time.monotonic() + DRAIN_S / 10):
            os.dup2(self.sink, self._descriptor)
            del _relays[self._descriptor]

    def _read(self) -> None:
        data = b"some"
        while data:  # until no process holds the other end of the pipe
            select.select([self._source], [], [])
            with self._reading, suppress(queue.Full):
                data = os.read(self._source, MAX_BYTES)
                self._waiting.put_nowait(data)

    def _print(self) -> None:
        while data := self._waiting.get():
            with suppress(OSError):  # lost terminal, or full disk
                while data:
                    data = data[os.write(self.sink, data) :]
            self._waiting.task_done()


_relays: dict[int, Relay] = {}  # of this process, by descriptor
