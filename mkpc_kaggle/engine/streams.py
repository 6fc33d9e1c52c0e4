"""Standard streams whose writes never wait: a thread prints, and drops what nobody reads.

A pipe that nobody reads and a stopped terminal (Ctrl-S) block a write for ever, and with it every thread that
wants the stream's lock. A terminal that goes away makes it fail (EIO).
"""

import io
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

MAX_WAITING = 1000  # texts: some minutes of a busy bar
DRAIN_S = 2.0  # that the end waits for what is still to be printed


class QueuedStream(io.TextIOBase):
    """Prints to ``stream`` in a daemon thread; texts that do not fit into its queue are dropped."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._waiting: queue.Queue[str | threading.Event] = queue.Queue(MAX_WAITING)
        self.is_stuck = False
        threading.Thread(target=self._print, name="print", daemon=True).start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    def fileno(self) -> int:
        return self._stream.fileno()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        with suppress(queue.Full):
            self._waiting.put_nowait(text)
        return len(text)

    def drain(self, until: float) -> None:
        """Wait until all is printed, or that moment of the monotonic clock; not for a stream that is stuck."""
        printed = threading.Event()
        try:
            self._waiting.put_nowait(printed)
        except queue.Full:
            self.is_stuck = True
        self.is_stuck = self.is_stuck or not printed.wait(max(0.0, until - time.monotonic()))

    def _print(self) -> None:
        while True:
            text = self._waiting.get()
            if isinstance(text, threading.Event):
                text.set()
                continue
            with suppress(OSError, ValueError):  # gone, full, or closed
                self._stream.write(text)
                self._stream.flush()


@contextmanager
def unblocked() -> Iterator[None]:
    """``sys.stdout`` and ``sys.stderr`` never wait meanwhile; what is left is printed in the end, if it is read.

    A stream that is stuck then stays as it is: what is printed later must not wait for it either.
    """
    former = {name: stream for name in ("stdout", "stderr") if (stream := getattr(sys, name)) is not None}
    for name, stream in former.items():
        setattr(sys, name, QueuedStream(stream))
    try:
        yield
    finally:
        drain()
        for name, stream in former.items():
            if not getattr(getattr(sys, name), "is_stuck", False):
                setattr(sys, name, stream)


def drain(seconds: float = DRAIN_S) -> None:
    """Print what is left, in so many seconds at most."""

    def flush() -> None:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                if isinstance(stream, QueuedStream):
                    stream.drain(until)
                elif stream is not None:
                    stream.flush()

    until = time.monotonic() + seconds
    thread = threading.Thread(target=flush, name="flush", daemon=True)
    thread.start()
    thread.join(seconds)
