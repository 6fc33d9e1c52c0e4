"""One worker after the other in one place, looked after by a thread of the parent."""

import queue
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from mkpc_kaggle.engine.jobs import Cause, Job, Lost, Matched
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.failures import DeviceError

MOST_STARTS = 3
"""A worker that fails to start that many times in a row is not started again."""
MOST_DEVICE_FAILURES = 6
"""A device that fails in that many jobs, with none done in between, is not used again.

More than a pair or two that the device fails at, and that alone, can cost: see :mod:`mkpc_kaggle.engine.losses`.
"""

Answer = tuple[Matched, ...] | Lost


class Hired(Protocol):
    """A worker as its keeper sees it, wherever it is."""

    def load(self) -> str: ...

    def do(self, job: Job) -> Answer: ...

    def announce(self, paths: Iterable[Path]) -> None: ...

    def stop(self) -> None: ...

    def kill(self) -> None: ...


class Employer(Protocol):
    """Has workers made, one after the other."""

    @property
    def name(self) -> str: ...

    def hire(self) -> Hired: ...


class Keeper:
    """Starts a worker, hands it one job after the other, and starts another where it died or had to be killed."""

    def __init__(self, seat: Employer, answered: Callable[[Job, Answer], None]) -> None:
        self.seat = seat
        self._given_up = ""
        self._device_failures = 0
        self._answered = answered
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._worker: Hired | None = None
        self._busy = self._closing = False
        self._started: Future[str] = Future()
        self._thread = threading.Thread(target=self._run, name=f"keeper of {seat.name}", daemon=True)

    def start(self) -> "Future[str]":
        """Start the worker; empty, or why it could not be. Raises what its pipeline's maker raises for users."""
        self._thread.start()
        return self._started

    @property
    def usable(self) -> bool:
        """Whether it has a worker, or can have one."""
        return not self._given_up

    @property
    def jobs(self) -> int:
        """How many it has, under way and waiting."""
        return self._queue.qsize() + self._busy

    def submit(self, job: Job) -> None:
        worker = self._worker
        if worker is not None:
            worker.announce(path for task in job.tasks for path in task.pair.images)
        self._queue.put(job)

    def stop(self) -> None:
        worker = self._worker
        if worker is not None:
            worker.stop()

    def close(self) -> bool:
        """Kill the worker; false where it is still being started, and will be killed then."""
        self._closing = True
        worker = self._worker
        if worker is not None:
            worker.kill()
        self._queue.put(None)
        if self._thread.ident is not None:
            self._thread.join(timeout=1.0)
        return not self._thread.is_alive()

    def _run(self) -> None:
        # Ctrl-C reaches every process of a terminal. The parent answers to it; workers inherit this mask.
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        try:
            self._ensure()
            self._started.set_result(self._given_up)
        except Exception as error:
            self._given_up = str(error)
            self._started.set_exception(error)
        while (job := self._queue.get()) is not None:
            self._busy = True
            answer = self._do(job)
            self._busy = False
            self._answered(job, answer)
        if self._worker is not None:
            self._worker.kill()

    def _do(self, job: Job) -> Answer:
        try:
            self._ensure()
        except (UserError, OSError) as error:
            self._given_up = str(error)
        if self._worker is None or not self.usable:
            return Lost(job, Cause.NO_WORKER, self._given_up)
        answer = self._worker.do(job)
        if not isinstance(answer, Lost):
            self._device_failures = 0
        elif answer.cause is not Cause.RAISED:
            self._worker.kill()  # what ran out of memory has it in pieces
            self._worker = None
            self._device_failures += answer.cause is Cause.DEVICE
        if self._device_failures >= MOST_DEVICE_FAILURES:
            self._given_up = f"{answer} ({MOST_DEVICE_FAILURES} times in a row)"
        return answer

    def _ensure(self) -> None:
        """See to it that there is a worker, or give up."""
        failure = "closed"
        for _ in range(MOST_STARTS):
            if self._worker is not None or self._closing or not self.usable:
                break
            self._worker = self.seat.hire()
            failure = "closed" if self._closing else self._load(self._worker)
            if failure:
                self._worker.kill()
                self._worker = None
        if self._worker is None:
            self._given_up = self._given_up or failure

    def _load(self, worker: Hired) -> str:
        try:
            return worker.load()
        except DeviceError as error:  # another device may do
            return str(error)
