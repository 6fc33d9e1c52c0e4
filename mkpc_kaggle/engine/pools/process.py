"""A worker process, one a device.

pebble, which keeps pools of processes, was tried and not taken: it times jobs by the wall clock, which may jump;
its workers share one pipe and its lock, so that a worker killed in the middle of sending a result blocks all of
them for good; and it cannot tell a busy worker which images come next.
"""

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

from mkpc_kaggle.engine.exits import how_it_ended
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure
from mkpc_kaggle.engine.pools.pool import START_SECONDS
from mkpc_kaggle.engine.pools.spawn import signals_blocked
from mkpc_kaggle.engine.worker import Answer, Worker
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.stages import Pipeline

WORKER_ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "THP_MEM_ALLOC_ENABLE": "1"}
"""For PyTorch, which reads them once.

Threads of OpenMP that wait for each other sleep. By default they spin, and keep the cores from decoding, MAGSAC
and other processes: ``python -m benchmarks.threads``. Tensors of 2 MiB and more come in huge pages, on Linux: in
small ones a fresh map costs a network as much time as many of its convolutions.
"""

Received = TypeVar("Received")
_environment = threading.Lock()


class ProcessWorker:
    """A worker process as its supervisor sees it, started with ``spawn``.

    ``make_pipeline`` can be pickled; ``share`` is the number of processes that share the machine's cores. Two
    pipes lead to the process and no locks are shared, so that it can be killed at any moment: jobs and answers go
    through one, what it is to know while it is busy through the other.
    """

    killable: ClassVar = True

    def __init__(self, name: str, make_pipeline: Callable[[], Pipeline], share: int = 1) -> None:
        context = multiprocessing.get_context("spawn")
        self._jobs, its_jobs = context.Pipe()
        its_messages, self._messages = context.Pipe(duplex=False)
        self._process: SpawnProcess = context.Process(
            target=serve, args=(make_pipeline, share, its_jobs, its_messages), name=f"mkpc {name}", daemon=True
        )
        with worker_environment(), signals_blocked():
            self._process.start()
        its_jobs.close()
        its_messages.close()

    def load(self) -> str:
        answer: object = self._within(START_SECONDS, self._jobs.recv)
        if isinstance(answer, UserError):
            raise answer
        if isinstance(answer, Cause):
            return f"{answer}: {how_it_ended(self._process)}"
        return str(answer)

    def run(self, job: Job) -> Answer:
        order = (job, job.deadline - time.monotonic())
        answer: Any = self._within(job.timeout, lambda: self._jobs.send(order))
        while answer is None:  # a heartbeat
            answer = self._within(job.timeout, self._jobs.recv)
        if not isinstance(answer, Cause):
            return cast(Answer, answer)
        message = f"nothing heard for {job.timeout:.0f} s" if answer is Cause.HUNG else how_it_ended(self._process)
        return JobFailure(job, answer, message)

    def prefetch(self, paths: Iterable[Path]) -> None:
        self._send(tuple(paths))  # a few hundred bytes: they fit into the pipe whether it listens or not

    def stop(self) -> None:
        self._send(None)

    def kill(self) -> None:
        self._process.kill()
        self._process.join(timeout=1.0)

    def _send(self, message: tuple[Path, ...] | None) -> None:
        try:
            self._messages.send(message)
        except OSError:
            return  # it is dead, and its supervisor will hear of it from the other pipe

    def _within(self, seconds: float, ask: Callable[[], Received]) -> Received | Cause:
        """What it answers; or the cause of its silence, after which it is dead."""
        hung = threading.Event()

        def end() -> None:
            hung.set()
            self._process.kill()

        timer = threading.Timer(min(seconds, threading.TIMEOUT_MAX), end)
        timer.daemon = True
        timer.start()
        try:
            return ask()
        except (EOFError, OSError):
            self.kill()
            return Cause.HUNG if hung.is_set() else Cause.DIED
        finally:
            timer.cancel()


@contextmanager
def worker_environment() -> Iterator[None]:
    """A process started meanwhile has :data:`WORKER_ENVIRONMENT`, but for what the user has set; this one has not
    (its own OpenMP library is loaded already).
    """
    with _environment:
        ours = {name: value for name, value in WORKER_ENVIRONMENT.items() if name not in os.environ}
        os.environ.update(ours)
        try:
            yield
        finally:
            for name in ours:
                del os.environ[name]


def serve(make_pipeline: Callable[[], Pipeline], share: int, jobs: Connection, messages: Connection) -> None:
    """A worker process's life."""
    worker = Worker(make_pipeline)
    threading.Thread(target=_listen, args=(worker, messages), daemon=True).start()
    try:
        _take_share(share)
        worker.load()
        jobs.send("")
    except UserError as error:
        jobs.send(error)
        return
    while True:
        job, seconds = jobs.recv()
        jobs.send(worker.run(job, seconds, lambda: jobs.send(None)))


def _listen(worker: Worker, messages: Connection) -> None:
    """Hear what the parent says while the worker is busy, and end with it, however it ended."""
    try:
        while True:
            paths = messages.recv()
            worker.stop() if paths is None else worker.prefetch(paths)
    except (EOFError, OSError):
        os._exit(1)


def _take_share(share: int) -> None:
    """Use a part of the cores, where other processes use the rest."""
    if share > 1:
        import cv2
        import torch

        torch.set_num_threads(max(1, torch.get_num_threads() // share))
        cv2.setNumThreads(max(1, cv2.getNumThreads() // share))
