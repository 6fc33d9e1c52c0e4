"""A pool of worker processes, one a device, each looked after by a thread of the parent.

pebble, which keeps such pools, was tried and not taken: it times jobs by the wall clock, which may jump; its
workers share one pipe and its lock, so that a worker killed in the middle of sending a result blocks all of
them for good; and it cannot tell a busy worker which images come next.
"""

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, TypeVar, cast

from mkpc_kaggle.engine.jobs import Cause, Finished, Job, Lost, Matched
from mkpc_kaggle.engine.pools.in_process import JOBS_A_WORKER, lost_by
from mkpc_kaggle.engine.pools.keeper import Answer, Employer, Keeper
from mkpc_kaggle.engine.worker import Bench, estimate
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe

START_SECONDS = 300.0
"""How long a worker may take to load its matchers; over a network's disk that is not quick."""

WORKER_ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}
"""Threads of OpenMP that wait for each other sleep. By default they spin, and keep the cores from decoding, MAGSAC
and other processes: ``python -m benchmarks.threads``. Read once, when PyTorch loads its OpenMP library."""

Heard = TypeVar("Heard")
_environment = threading.Lock()


@dataclass(frozen=True)
class Seat:
    """What a worker process is started with: a pipeline's maker that can be pickled, and its part of the CPU.

    ``share`` is the number of processes that share the machine's cores.
    """

    name: str
    make_pipeline: Callable[[], Pipeline]
    share: int = 1

    def hire(self) -> "Worker":
        return Worker(self)


class ProcessPool:
    """Matching in processes started with ``spawn``; F is estimated here, in threads, while they go on matching.

    Where no worker can be started in any of the ``seats``, the work is done in ``fallback``.
    """

    def __init__(self, seats: Sequence[Employer], recipe: Recipe, fallback: Employer | None = None) -> None:
        self._recipe = recipe
        self._fallback = fallback
        self._back: queue.SimpleQueue[Finished | Lost] = queue.SimpleQueue()
        self._out = 0
        self._take_on(seats)

    @property
    def workers(self) -> int:
        return sum(keeper.usable for keeper in self._keepers)

    @property
    def capacity(self) -> int:
        return JOBS_A_WORKER * self.workers

    def start(self) -> str:
        failures = self._start_all()
        told = "; ".join(filter(None, failures))
        if not all(failures):
            return told and f"some workers could not be started: {told}"
        if self._fallback is not None:
            for keeper in self._keepers:
                keeper.close()
            self._take_on([self._fallback])
            if not any(self._start_all()):
                return f"no worker could be started but on the {self._fallback.name}: {told}"
        raise UserError(f"no worker could be started: {told}")

    def submit(self, job: Job) -> None:
        self._out += 1
        min((one for one in self._keepers if one.usable), key=lambda keeper: keeper.jobs).submit(job)

    def next(self, until: float) -> Finished | Lost | None:
        try:
            back = self._back.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            return None
        self._out -= 1
        return back

    def stop(self) -> None:
        for keeper in self._keepers:
            keeper.stop()

    def close(self) -> bool:
        idle = self._out == 0
        ended = [keeper.close() for keeper in self._keepers]
        self._estimating.shutdown(wait=idle, cancel_futures=True)
        return idle and all(ended)

    def _start_all(self) -> list[str]:
        """Start all workers at once; for each nothing, or why it could not be started."""
        started = [keeper.start() for keeper in self._keepers]
        return [future.result() for future in started]

    def _take_on(self, seats: Sequence[Employer]) -> None:
        self._estimating = ThreadPoolExecutor(max(1, len(seats)), thread_name_prefix="estimate")
        self._keepers = [Keeper(seat, self._answered) for seat in seats]

    def _answered(self, job: Job, answer: Answer) -> None:
        if isinstance(answer, Lost):
            self._back.put(answer)
        else:
            self._estimating.submit(self._estimate, job, answer)

    def _estimate(self, job: Job, matched: tuple[Matched, ...]) -> None:
        try:
            self._back.put(estimate(job, matched, self._recipe))
        except Exception as error:
            self._back.put(lost_by(job, error))


class Worker:
    """A worker process as its keeper sees it.

    Two pipes lead to it and no locks are shared, so that it can be killed at any moment: jobs and answers go
    through one, what it is to know while it is busy through the other.
    """

    def __init__(self, seat: Seat) -> None:
        context = multiprocessing.get_context("spawn")
        self._jobs, its_jobs = context.Pipe()
        its_words, self._words = context.Pipe(duplex=False)
        self._process: SpawnProcess = context.Process(
            target=serve, args=(seat, its_jobs, its_words), name=f"mkpc {seat.name}", daemon=True
        )
        with worker_environment():
            self._process.start()
        its_jobs.close()
        its_words.close()

    def load(self) -> str:
        """Wait until the matchers are loaded; empty, or why they are not. Raises the :class:`UserError` it met."""
        answer: object = self._within(START_SECONDS, self._jobs.recv)
        if isinstance(answer, UserError):
            raise answer
        if isinstance(answer, Cause):
            return f"{answer}: {self._ended()}"
        return str(answer)

    def do(self, job: Job) -> Answer:
        """Its answer, or what became of it."""
        order = (job, job.plan.deadline - time.monotonic())
        answer: Any = self._within(job.plan.timeout, lambda: self._jobs.send(order))
        while answer is None:  # an answer, or the sign that it lives
            answer = self._within(job.plan.timeout, self._jobs.recv)
        if not isinstance(answer, Cause):
            return cast(Answer, answer)
        told = f"nothing heard for {job.plan.timeout:.0f} s" if answer is Cause.HUNG else self._ended()
        return Lost(job, answer, told)

    def announce(self, paths: Iterable[Path]) -> None:
        """Tell it to decode these ahead. A few hundred bytes: they fit into the pipe whether it listens or not."""
        self._say(tuple(paths))

    def stop(self) -> None:
        self._say(None)

    def kill(self) -> None:
        self._process.kill()
        self._process.join(timeout=1.0)

    def _say(self, words: tuple[Path, ...] | None) -> None:
        try:
            self._words.send(words)
        except OSError:
            return  # it is dead, and its keeper will hear of it from the other pipe

    def _within(self, seconds: float, ask: Callable[[], Heard]) -> Heard | Cause:
        """What it answers; or the cause of its silence, after which it is dead."""
        hung = threading.Event()

        def end() -> None:
            hung.set()
            self._process.kill()

        fuse = threading.Timer(min(seconds, threading.TIMEOUT_MAX), end)
        fuse.daemon = True
        fuse.start()
        try:
            return ask()
        except (EOFError, OSError):
            self.kill()
            return Cause.HUNG if hung.is_set() else Cause.DIED
        finally:
            fuse.cancel()

    def _ended(self) -> str:
        code = self._process.exitcode
        return f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit status {code}"


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


def serve(seat: Seat, jobs: Connection, words: Connection) -> None:
    """A worker process's life."""
    bench = Bench(seat.make_pipeline)
    threading.Thread(target=_listen, args=(bench, words), daemon=True).start()
    try:
        _take_part(seat.share)
        bench.load()
        jobs.send("")
    except UserError as error:
        jobs.send(error)
        return
    while True:
        job, seconds = jobs.recv()
        jobs.send(answer_of(bench, job, seconds, lambda: jobs.send(None)))


def answer_of(bench: Bench, job: Job, seconds: float, alive: Callable[[], None]) -> Answer:
    """What a worker answers to a job."""
    try:
        return bench.match(job, seconds, alive)
    except Exception as error:
        return lost_by(job, error)


def _listen(bench: Bench, words: Connection) -> None:
    """Hear what the parent says while the worker is busy, and end with it, however it ended."""
    try:
        while True:
            paths = words.recv()
            bench.stop() if paths is None else bench.announce(paths)
    except (EOFError, OSError):
        os._exit(1)


def _take_part(share: int) -> None:
    """Use a part of the cores, where other processes use the rest."""
    if share > 1:
        import cv2
        import torch

        torch.set_num_threads(max(1, torch.get_num_threads() // share))
        cv2.setNumThreads(max(1, cv2.getNumThreads() // share))
