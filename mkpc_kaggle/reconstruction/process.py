"""Calls in a process of their own, which OpenCV or pycolmap may end."""

import signal
import time
from collections.abc import Callable, Iterator
from math import inf
from multiprocessing import get_context
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.failures import reason_of
from mkpc_kaggle.signals import end_with_parent


class Child:
    """A process that sends what a generator function yields."""

    def __init__(self, function: Callable[..., Iterator[Any]], *args: Any) -> None:
        # A fork would copy the locks of the parent's threads.
        context = get_context("spawn")
        self._answers, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_run, args=(sender, function, args), daemon=True
        )
        self._process.start()
        # The child's end alone stays open, so its death ends the wait.
        sender.close()

    def next(self, ends: float = inf) -> Any:
        """Return the next value. Raise :class:`UserError` if the function has failed, the process has
        ended, or no value comes until ``ends`` on the monotonic clock.
        """
        left = None if ends == inf else max(0.0, ends - time.monotonic())
        if not self._answers.poll(left):
            raise UserError("no time was left")
        try:
            answer = self._answers.recv()
        except EOFError:
            self._process.join()
            raise UserError(
                f"its process ended with status {self._process.exitcode}"
            ) from None
        if isinstance(answer, UserError):
            raise answer
        return answer

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        self._answers.close()


def _run(sender: Any, function: Callable[..., Iterator[Any]], args: tuple[Any, ...]) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal; the parent decides
    try:
        for value in function(*args):
            sender.send(value)
    except Exception as error:  # any error of pycolmap
        sender.send(UserError(reason_of(error)))
