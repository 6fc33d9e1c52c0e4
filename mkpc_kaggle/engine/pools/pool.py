"""A pool of workers, each supervised by a thread of the parent, which hands it one job after the other."""

import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure, JobResult
from mkpc_kaggle.engine.pools.scene_process import SceneProcess
from mkpc_kaggle.engine.scenes import Reconstruction, SceneJob
from mkpc_kaggle.engine.worker import Answer, estimate, failed
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.failures import DeviceError
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Recipe

START_SECONDS = 300.0
"""How long a worker may take to load its matchers; over a network's disk that is not quick."""
JOBS_A_WORKER = 2
"""One is matched while F is estimated for the one before it; the next waits."""
MOST_STARTS = 3
"""A worker that fails to start that many times in a row is not started again."""
MOST_DEVICE_FAILURES = 6
"""A device that fails in that many jobs, with none done in between, is not used again.

More than a pair or two that the device fails at, and that alone, can cost: see :mod:`mkpc_kaggle.engine.retries`.
"""


class WorkerHandle(Protocol):
    """A worker as its supervisor sees it, wherever it is. What crosses to it and back is plain values."""

    killable: ClassVar[bool]
    """whether :meth:`kill` ends it at once, whatever it does"""

    def load(self) -> str:
        """Wait until the matchers are loaded; empty, or why they are not. Raises the ``UserError`` it met."""
        ...

    def run(self, job: Job) -> Answer:
        """What it made of the job, or what became of the worker; after such a failure it is killed."""
        ...

    def prefetch(self, paths: Iterable[Path]) -> None:
        """Tell it to decode these ahead, busy as it may be."""
        ...

    def stop(self) -> None:
        """Tell it to begin no further unit."""
        ...

    def kill(self) -> None: ...


@dataclass(frozen=True)
class Place:
    """Where a worker runs, such as "cuda:0 1", and how one is started there; started anew when it is lost."""

    name: str
    start: Callable[[], WorkerHandle]


class Pool:
    """Does jobs; each that was submitted comes back once, done or failed, in any order.

    Matching happens in the workers; F is estimated here, in threads, while they go on matching: OpenCV releases
    the interpreter's lock meanwhile. Where no worker can be started in any of the ``places``, the work is done in
    ``fallback``.
    """

    def __init__(self, places: Sequence[Place], recipe: Recipe, fallback: Place | None = None) -> None:
        self._recipe = recipe
        self._fallback = fallback
        self._back: queue.SimpleQueue[JobResult | JobFailure] = queue.SimpleQueue()
        self._out = 0
        self._settle(places)

    @property
    def workers(self) -> int:
        """How many work at a time; fewer where some could not be kept alive."""
        return sum(supervisor.usable for supervisor in self._supervisors)

    @property
    def capacity(self) -> int:
        """How many jobs may be out: enough that no worker waits for its next one."""
        return JOBS_A_WORKER * self.workers

    def start(self) -> str:
        """Start the workers; empty, or what the user should know of it.

        Raises :class:`mkpc_kaggle.errors.UserError` where none can be started.
        """
        failures = self._start_all()
        message = "; ".join(filter(None, failures))
        if not all(failures):
            return message and f"some workers could not be started: {message}"
        if self._fallback is not None:
            for supervisor in self._supervisors:
                supervisor.close()
            self._settle([self._fallback])
            if not any(self._start_all()):
                return f"no worker could be started but on the {self._fallback.name}: {message}"
        raise UserError(f"no worker could be started: {message}")

    def submit(self, job: Job) -> None:
        """Queue a job; its images may be decoded ahead from now on."""
        self._out += 1
        usable = [one for one in self._supervisors if one.usable] or self._supervisors  # who has given up says so
        min(usable, key=lambda one: one.jobs).submit(job)

    def next(self, until: float) -> JobResult | JobFailure | None:
        """A job that has come back, waiting for it if need be; ``None`` at ``until``, of the engine's clock."""
        try:
            back = self._back.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            return None
        self._out -= 1
        return back

    @property
    def scenes_at_once(self) -> int:
        """How many batches may be reconstructed at a time, beside matching."""
        return 1

    def reconstruct(self, job: SceneJob) -> Reconstruction:
        """Begin to reconstruct a batch."""
        return SceneProcess(job)

    def stop(self) -> None:
        """Begin no further unit: jobs under way and those that wait end with what they have."""
        for supervisor in self._supervisors:
            supervisor.stop()

    def close(self) -> bool:
        """Let go of everything; false where something is still running and cannot be stopped."""
        idle = self._out == 0
        ended = [supervisor.close() for supervisor in self._supervisors]
        self._estimating.shutdown(wait=idle, cancel_futures=True)
        return idle and all(ended)

    def _start_all(self) -> list[str]:
        """Start all workers at once; for each nothing, or why it could not be started."""
        started = [supervisor.start() for supervisor in self._supervisors]
        return [future.result() for future in started]

    def _settle(self, places: Sequence[Place]) -> None:
        self._estimating = ThreadPoolExecutor(max(1, len(places)), thread_name_prefix="estimate")
        self._supervisors = [Supervisor(place, self._answered) for place in places]

    def _answered(self, job: Job, answer: Answer) -> None:
        if isinstance(answer, JobFailure):
            self._back.put(answer)
        else:
            with suppress(RuntimeError):  # closed meanwhile: nobody waits for it any more
                self._estimating.submit(self._estimate, job, answer)

    def _estimate(self, job: Job, found: tuple[PairMatch, ...]) -> None:
        self._back.put(estimate(job, found, self._recipe))


class Supervisor:
    """Starts a worker, hands it one job after the other, and starts another where it died or had to be killed."""

    def __init__(self, place: Place, answered: Callable[[Job, Answer], None]) -> None:
        self._place = place
        self._given_up = ""
        self._device_failures = 0
        self._answered = answered
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._worker: WorkerHandle | None = None
        self._busy = self._closing = False
        self._started: Future[str] = Future()
        self._thread = threading.Thread(target=self._run, name=f"supervisor of {place.name}", daemon=True)

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
            worker.prefetch(job.images)
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
            self._thread.join(timeout=1.0 if worker is None or worker.killable or not self._busy else 0.0)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._ensure_worker()
            self._started.set_result(self._given_up)
        except Exception as error:
            self._given_up = str(error)
            self._started.set_exception(error)
        while (job := self._queue.get()) is not None:
            self._busy = True
            try:
                answer = self._do(job)
            except Exception as error:  # without this thread the run would wait for ever
                answer = failed(job, error)
                self._end_worker()
            self._busy = False
            self._answered(job, answer)
        self._end_worker()

    def _end_worker(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.kill()

    def _do(self, job: Job) -> Answer:
        try:
            self._ensure_worker()
        except (UserError, OSError) as error:
            self._given_up = str(error)
        if self._worker is None or not self.usable:
            return JobFailure(job, Cause.NO_WORKER, self._given_up)
        answer = self._worker.run(job)
        if not isinstance(answer, JobFailure):
            self._device_failures = 0
        elif answer.cause is not Cause.RAISED:
            self._end_worker()  # what ran out of memory has it in pieces
            self._device_failures += answer.cause is Cause.DEVICE
        if self._device_failures >= MOST_DEVICE_FAILURES:
            self._given_up = f"{answer} ({MOST_DEVICE_FAILURES} times in a row)"
        return answer

    def _ensure_worker(self) -> None:
        """See to it that there is a worker, or give up."""
        failure = "closed"
        for _ in range(MOST_STARTS):
            if self._worker is not None or self._closing or not self.usable:
                break
            self._worker = self._place.start()
            failure = "closed" if self._closing else self._load(self._worker)
            if failure:
                self._end_worker()
        if self._worker is None:
            self._given_up = self._given_up or failure

    def _load(self, worker: WorkerHandle) -> str:
        try:
            return worker.load()
        except DeviceError as error:  # another device may do
            return str(error)
