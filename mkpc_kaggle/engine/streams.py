"""Standard streams whose writes never wait: threads relay what is written to descriptors 1 and 2.

A pipe without a reader and a stopped terminal (Ctrl-S) block a write forever, and with it every thread that waits
for the stream's lock. A terminal that goes away makes it fail (EIO). Native libraries write to the descriptors
themselves: libjpeg and libpng complain of a photograph while OpenCV decodes it. Worker processes inherit both.
"""

import os
import queue
import select
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TextIO

MAX_WAITING = 1000  # writes: some minutes of a busy bar
MAX_BYTES = 4096  # of a read
DRAIN_S = 2.0  # how long the end waits for the remaining text


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

    def restore(self) -> None:
        """Give the descriptor its file back."""
        os.dup2(self.sink, self._descriptor)

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


@contextmanager
def unblocked(*names: str) -> Iterator[None]:
    """``sys.stdout`` and ``sys.stderr``, or the named one, never wait; the end prints the rest, if it is read.

    A stream that is stuck is relayed for as long as the process lives: later text does not wait for it either.
    Streams elsewhere, such as a notebook's, stay as they are.
    """
    with ExitStack() as ended:
        for number, name in enumerate(("stdout", "stderr"), start=1):
            stream = getattr(sys, name)
            if name in (names or ("stdout", "stderr")) and number not in _relays and _descriptor(stream) == number:
                stream.flush()
                _relays[number] = Relay(number)
                ended.callback(_restore, number)
        ended.callback(drain)
        yield


def _restore(descriptor: int) -> None:
    if _relays[descriptor].drain(time.monotonic() + DRAIN_S / 10):
        _relays.pop(descriptor).restore()


def _descriptor(stream: TextIO | None) -> int:
    """Return the descriptor of a stream that a write can block; -1 for another."""
    with suppress(OSError, ValueError, AttributeError):
        return stream.fileno() if stream is not None and sys.platform != "win32" else -1
    return -1


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream ends at a terminal, perhaps behind a relay."""
    descriptor = _descriptor(stream)
    return os.isatty(_relays[descriptor].sink if descriptor in _relays else descriptor)


def drain(seconds: float = DRAIN_S) -> None:
    """Print the remaining text, for at most ``seconds``."""

    def flush() -> None:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                if stream is not None:
                    stream.flush()
        for relay in list(_relays.values()):
            relay.drain(until)

    until = time.monotonic() + seconds
    thread = threading.Thread(target=flush, name="flush", daemon=True)
    thread.start()
    thread.join(seconds)
