"""Standard streams whose writes never wait: a thread prints, and drops what is not read.

A pipe without a reader and a stopped terminal (Ctrl-S) block a write forever, and with it every thread that waits
for the stream's lock. A terminal that goes away makes it fail (EIO). Native libraries write to descriptors 1 and 2
themselves: libjpeg and libpng complain of a photograph while OpenCV decodes it.
"""

import io
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, TextIO

MAX_WAITING = 1000  # writes: some minutes of a busy bar
MAX_BYTES = 4096  # of a write of native code
DRAIN_S = 2.0  # how long the end waits for the remaining text


class QueuedStream(io.TextIOBase):
    """Prints to ``stream`` in a daemon thread; texts that do not fit into its queue are dropped.

    ``descriptor`` is one that native code writes to: until ``restore`` its text goes through the same queue.
    """

    def __init__(self, stream: TextIO, descriptor: int | None = None) -> None:
        self._stream = stream
        self._descriptor = descriptor
        self._waiting: queue.Queue[Callable[[], object]] = queue.Queue(MAX_WAITING)
        self.is_stuck = False
        if descriptor is not None:
            self._stream = _duplicate(stream)
            self._native, pipe = os.pipe()
            os.set_blocking(pipe, False)  # whoever fills it before it is read loses text, and never waits
            os.dup2(pipe, descriptor)
            os.close(pipe)
            self._relaying = threading.Lock()
            threading.Thread(target=self._relay, name="relay", daemon=True).start()
        threading.Thread(target=self._print, name="print", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    @property
    def errors(self) -> str | None:  # type: ignore[override]
        return self._stream.errors

    @property
    def buffer(self) -> "QueuedBytes":
        return QueuedBytes(self._stream.buffer.write, self._put)

    def reconfigure(self, **options: Any) -> None:
        self._put(partial(self._stream.reconfigure, **options))  # type: ignore[attr-defined]

    def fileno(self) -> int:
        return self._stream.fileno()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        self._put(partial(self._stream.write, text))
        return len(text)

    def drain(self, until: float) -> None:
        """Wait until all is printed, or that moment of the monotonic clock; not for a stream that is stuck."""
        if self._descriptor is not None:
            while select.select([self._native], [], [], 0)[0] and time.monotonic() < until:
                time.sleep(0.001)
            with self._relaying:  # read, and not yet queued
                pass
        printed = threading.Event()
        try:
            self._waiting.put_nowait(printed.set)
        except queue.Full:
            self.is_stuck = True
        self.is_stuck = self.is_stuck or not printed.wait(max(0.0, until - time.monotonic()))

    def restore(self) -> None:
        """Give native code its descriptor back."""
        if self._descriptor is not None:
            os.dup2(self._stream.fileno(), self._descriptor)

    def _put(self, write: Callable[[], object]) -> None:
        with suppress(queue.Full):
            self._waiting.put_nowait(write)

    def _print(self) -> None:
        while True:
            write = self._waiting.get()
            with suppress(Exception):  # gone, full, closed; a letter that the encoding cannot write
                write()
                self._stream.flush()

    def _relay(self) -> None:
        """Queue what native code writes, until no process can write it any more."""
        while select.select([self._native], [], []):
            with self._relaying:
                if not (data := os.read(self._native, MAX_BYTES)):
                    return
                self.buffer.write(data)


class QueuedBytes(io.BufferedIOBase):
    """The ``buffer`` of a queued stream."""

    def __init__(self, write: Callable[[bytes], object], put: Callable[[Callable[[], object]], None]) -> None:
        self._write, self._put = write, put

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        whole = bytes(memoryview(data))  # TypeError for text
        self._put(partial(self._write, whole))
        return len(whole)


def _duplicate(stream: TextIO) -> TextIO:
    """Return a stream to the same file, by a descriptor that native code does not know."""
    raw = io.FileIO(os.dup(stream.fileno()), "w")
    raw.name = stream.name
    return io.TextIOWrapper(io.BufferedWriter(raw), stream.encoding, stream.errors, newline="\n")


@contextmanager
def unblocked(*names: str) -> Iterator[None]:
    """``sys.stdout`` and ``sys.stderr``, or the named one, never wait; the end prints the rest, if it is read.

    A stream that is stuck stays queued, so that later text does not wait for it either.
    """
    with ExitStack() as ended:
        for number, name in enumerate(("stdout", "stderr"), start=1):
            stream = getattr(sys, name)
            if stream is not None and name in (names or ("stdout", "stderr")):
                queued = QueuedStream(stream, number if _may_block(stream, number) else None)
                setattr(sys, name, queued)
                ended.callback(_restore, name, queued, stream)
        ended.callback(drain)
        yield


def _restore(name: str, queued: QueuedStream, former: TextIO) -> None:
    if not queued.is_stuck:
        queued.restore()
        setattr(sys, name, former)


def _may_block(stream: TextIO, descriptor: int) -> bool:
    """Return whether the stream has this descriptor, and this blocks; those that a worker inherits do not."""
    with suppress(OSError, ValueError, AttributeError):
        return sys.platform != "win32" and stream.fileno() == descriptor and os.get_blocking(descriptor)
    return False


def drain(seconds: float = DRAIN_S) -> None:
    """Print the remaining text, for at most ``seconds``."""

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
