"""Where workers are: a place has one worker at a time, and is closed when it loses three in a row.

A worker that has not answered by :attr:`Place.limit`, which :meth:`Engine._time_limit` sets, is killed in
:meth:`Place._fail`: its process gets SIGKILL.
"""

import os
import queue
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from math import inf

from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job, Loaded
from mkpc_kaggle.engine.process import ProcessWorker, ThreadWorker
from mkpc_kaggle.engine.worker import MatchRunner, light_runner, scene_runner
from mkpc_kaggle.pipeline.assembly import Assembly

START_TIMEOUT_S = 300.0  # for a worker to load its matchers; over a network's disk that is not quick
RESTART_PAUSE_S = 1.0  # times the workers lost in a row: memory that is short may be free again
MAX_LOSSES = 3  # workers lost in a row, with no answer between, close a place
LISTEN_S = 0.2  # how often an interrupt is looked for
CORES_PER_ESTIMATOR = 4


class Work(StrEnum):
    """The work of a place's workers."""

    MATCH = "matching"
    LIGHT = "estimates"  # and looks at images
    SCENE = "scenes"


@dataclass(eq=False)
class Place:
    """A place such as "cuda:0": its worker and the worker's job, since a moment of the engine's clock.

    An answer is awaited until ``limit``; without a worker, none is started before it. ``closed`` is the reason if
    no more workers start here.
    """

    name: str
    make: Callable[[], ThreadWorker]
    work: Work = Work.MATCH
    worker: ThreadWorker | None = None
    job: Job | None = None
    is_loaded: bool = False
    losses: int = 0
    closed: str = ""
    since: float = 0.0
    limit: float = -inf

    @property
    def is_idle(self) -> bool:
        return self.is_loaded and self.job is None

    @property
    def is_starting(self) -> bool:
        """Whether a worker is loading, or may be started again after a pause."""
        return not self.is_loaded and not self.closed and (self.worker is not None or self.losses > 0)

    def may_start(self, now: float) -> bool:
        return self.worker is None and not self.closed and now >= self.limit

    def start(self, now: float, timeout: float = START_TIMEOUT_S) -> None:
        """Start a worker, which answers when it is loaded."""
        self.since, self.limit = now, now + timeout
        self.worker = self.make()
        self.worker.start()

    def submit(self, job: Job, time_limit: float, now: float) -> None:
        """Hand a job to the idle worker."""
        assert self.worker is not None
        self.job, self.since, self.limit = job, now, now + time_limit
        self.worker.submit(job)

    def poll(self, now: float) -> Answer | None:
        """Return the worker's answer, or that it hangs; ``None`` while it computes."""
        if self.worker is None:
            return None
        answer = self.worker.answer()
        if answer is None and now >= self.limit:
            answer = Failure(Cause.TIMED_OUT, f"no answer for {now - self.since:.0f} s")
        if answer is None:
            return None
        self.limit = inf
        if isinstance(answer, Failure):
            self._fail(answer, now)
        elif isinstance(answer, Loaded):
            self.is_loaded = True
        else:
            self.losses = 0
        return answer

    def kill(self) -> None:
        if self.worker is not None:
            self.worker.kill()
            self.worker, self.is_loaded, self.limit = None, False, -inf

    def _fail(self, failure: Failure, now: float) -> None:
        """End the worker, unless its job alone failed.

        Memory that ran out is fragmented, and a failing device keeps failing. Short memory does not count against
        the place, nor does a death or a hang if another worker was lost at the same job.
        """
        is_retry = self.job is not None and self.job.is_retry and failure.cause in (Cause.DIED, Cause.TIMED_OUT)
        if self.is_loaded and failure.cause in (Cause.RAISED, Cause.OUT_OF_MEMORY):
            self.losses = 0
            if failure.cause is Cause.RAISED:
                return
        elif not is_retry:
            self.losses += 1
            if self.losses >= MAX_LOSSES or failure.cause is Cause.REFUSED:
                self.closed = f"{self.name}: {failure}"
        self.kill()
        self.limit = now + RESTART_PAUSE_S * self.losses


class Site:
    """The places of a run. Matching may be elsewhere, estimates and scenes are next to the journal.

    ``fallback`` are the matching places that take over when the others are closed. Workers call ``ring`` when an
    answer is ready.
    """

    def __init__(self, clock: Callable[[], float], *, threads: bool = False) -> None:
        self._clock = clock
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._worker = ThreadWorker if threads else ProcessWorker
        estimators = 1 if threads else max(1, (os.cpu_count() or 1) // CORES_PER_ESTIMATOR)
        self.places = [
            Place(f"estimates {n}", lambda: self._worker("estimates", light_runner, self.ring), Work.LIGHT)
            for n in range(estimators)
        ]
        self.places.append(Place("scenes", self.scene_worker, Work.SCENE))
        self.fallback: list[Place] = []

    def of(self, work: Work) -> list[Place]:
        return [place for place in self.places if place.work is work]

    def open(self) -> None:
        """Add the matching places. Raise :class:`mkpc_kaggle.errors.UserError` if there can be none."""

    def scene_worker(self) -> ThreadWorker:
        """Return a worker for a scene: always a process, since pycolmap may crash."""
        return ProcessWorker("scene", scene_runner, self.ring)

    def ring(self) -> None:
        self._bell.put(None)

    def wait(self, until: float) -> None:
        """Wait until an answer may be ready, for an interrupt, or until a moment of the engine's clock."""
        with suppress(queue.Empty):
            self._bell.get(timeout=max(0.0, min(LISTEN_S, until - self._clock())))

    def close(self) -> None:
        """Release the site; its workers have been killed."""


class LocalSite(Site):
    """A worker process for each device of the machine, or ``workers`` processes; 0: a thread of this process."""

    def __init__(self, assembly: Assembly, workers: int | None, clock: Callable[[], float]) -> None:
        super().__init__(clock, threads=workers == 0)
        if workers == 0:
            self.places.append(self._place("this process", assembly))
            return
        # On a CPU one process with all threads: two with half of them each do more (recipe light, two cores: the
        # sweep over after 22 s instead of 31), but need twice the memory, and a network's last bits change.
        devices = assembly.devices
        used = [devices[number % len(devices)] for number in range(workers or len(devices))]
        for number, device in enumerate(used):
            count = used.count(device)
            name = device if count == 1 else f"{device} {number}"
            self.places.append(self._place(name, assembly.on(device, count), len(used)))
        if devices != ("cpu",):
            self.fallback = [self._place("cpu", assembly.on_cpu())]

    def _place(self, name: str, assembly: Assembly, share: int = 1) -> Place:
        make = partial(MatchRunner, assembly.pipeline, share=share)
        return Place(name, lambda: self._worker(f"mkpc {name}", make, self.ring))
