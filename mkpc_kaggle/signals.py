"""Ctrl-C and SIGTERM as an event, which work checks, or as an exception, and the end of a parent."""

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType

PR_SET_PDEATHSIG = 1  # of Linux's prctl


class Interrupt(threading.Event):
    """Event that is set when the run must end early. ``signal`` is the number of the signal
    received, or 0.
    """

    signal = 0
    raises = False

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Raise ``KeyboardInterrupt(number)`` on a signal, for work that does not check the event."""
        self.raises = True
        try:
            yield
        finally:
            self.raises = False


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """Let SIGTERM and Ctrl-C set the interrupt, unless the parent program ignores them. A second
    signal has its default effect.
    """
    interrupt = Interrupt()
    with ExitStack() as restored:

        def note(number: int, _: FrameType | None) -> None:
            restored.close()  # first, so that a second signal ends even a hung program
            interrupt.signal = number
            interrupt.set()
            if interrupt.raises:
                raise KeyboardInterrupt(number)

        for number in (signal.SIGINT, signal.SIGTERM):
            former = signal.getsignal(number)
            # A shell's background job ignores Ctrl-C, which is for the script, and so does nohup.
            if former is not signal.SIG_IGN:
                restored.callback(signal.signal, number, former)
                signal.signal(number, note)
        yield interrupt


def end_with_parent() -> None:
    """End this process with its parent, even during a computation.

    On Linux, it also ends with the thread that started it, and even if stopped (SIGSTOP).
    """
    with suppress(OSError, AttributeError):  # not on Linux
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

    def wait() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
