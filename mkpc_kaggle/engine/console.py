"""The only place that prints during a run: lines, warnings, progress. It never raises, and never waits in a run.

A pipe without a reader and a stopped terminal (Ctrl-S) block a write forever, and with it every thread that waits
for the stream's lock. A terminal that goes away (EIO), a full disk and a closed stream make it fail. Native
libraries write to the descriptors themselves: libjpeg and libpng complain of a photograph while OpenCV decodes it.
So threads relay what is written to descriptors 1 and 2, in worker processes, too.
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

LINE_INTERVAL_S = 30.0  # between lines of progress where a line cannot be drawn again
MAX_WAITING = 1000  # writes: some minutes of a busy line
MAX_BYTES = 4096  # of a read
DRAIN_S = 2.0  # how long the end waits for the remaining text


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


@contextmanager
def unblocked(descriptors: Sequence[int] = (1, 2)) -> Iterator[None]:
    """Let no write to ``sys.stdout`` and ``sys.stderr`` at these descriptors wait. Print the rest at the end.

    Streams elsewhere, such as a notebook's, stay as they are.
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
    """Print the remaining text, for at most ``seconds``."""

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
    """End the process and its children, even stopped ones (SIGSTOP). Printing the rest may take ``seconds``."""
    for child in multiprocessing.active_children():
        child.kill()
    drain(seconds)
    os._exit(status)


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream ends at a terminal, perhaps behind a relay."""
    descriptor = _descriptor(stream)
    return os.isatty(_relays[descriptor].sink if descriptor in _relays else descriptor)


def _descriptor(stream: TextIO | None) -> int:
    """Return the descriptor of a stream that a write can block; -1 for another."""
    with suppress(OSError, ValueError, AttributeError):
        return stream.fileno() if stream is not None and sys.platform != "win32" else -1
    return -1


class Relay:
    """Relays text from a descriptor to its file, ``sink``, with two threads: one reads, one prints.

    Text that does not fit into the queue between them is dropped, and text that the file refuses.
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
        """Wait until all is printed, or that moment of the monotonic clock. Return whether it was."""
        while time.monotonic() < until:
            with self._reading:
                if not select.select([self._source], [], [], 0)[0] and not self._waiting.unfinished_tasks:
                    return True
            time.sleep(0.002)
        return False

    def close(self) -> None:
        """Give the descriptor its file back, unless that is stuck: later text must not wait for it either."""
        if self.drain(time.monotonic() + DRAIN_S / 10):
            os.dup2(self.sink, self._descriptor)
            del _relays[self._descriptor]

    def _read(self) -> None:
        data = b"some"
        while data:  # until no process can write any more
            select.select([self._source], [], [])
            with self._reading, suppress(queue.Full):
                data = os.read(self._source, MAX_BYTES)
                self._waiting.put_nowait(data)

    def _print(self) -> None:
        while data := self._waiting.get():
            with suppress(OSError):  # gone, or full
                while data:
                    data = data[os.write(self.sink, data) :]
            self._waiting.task_done()


_relays: dict[int, Relay] = {}  # of this process, by descriptor
