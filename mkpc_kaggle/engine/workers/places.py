"""Places of workers. A place has one worker at a time, and is closed after it loses three different
items in a row (:mod:`mkpc_kaggle.engine.plan.blame`).

A hung worker ends here: :meth:`Place.poll` kills a worker that has not answered by :attr:`Place.limit`, which the
loop sets (:mod:`mkpc_kaggle.engine.plan.time_limits`).
"""

import queue
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from math import inf
from pathlib import Path

from mkpc_kaggle.cores import available_cores
from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job, Loaded
from mkpc_kaggle.engine.plan.blame import MAX_LOSSES, Item, different
from mkpc_kaggle.engine.workers.process import ProcessWorker, ThreadWorker
from mkpc_kaggle.engine.workers.worker import Maker, MatchRunner, estimates_runner, scene_runner
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.stages import Pipeline

# Times the number of workers lost in a row: scarce memory may become free meanwhile.
RESTART_PAUSE_S = 1.0
LISTEN_S = 0.2  # between checks for an interrupt, since a signal does not ring
# An estimate takes a fraction of a pair's matching on a CPU; on a GPU, the other cores decode images.
CORES_PER_ESTIMATOR = 4


class Work(StrEnum):
    """The work of a place's workers."""

    MATCH = "matching"
    ESTIMATE = "estimates"  # and features of images
    SCENE = "scenes"


@dataclass(eq=False)
class Place:
    """A place such as "cuda:0", with its worker and the worker's job, which began at ``since``.

    ``since`` and ``limit`` are times of the engine's clock. A worker must answer by ``limit``; without a worker,
    the next may start then. ``closed`` is the reason why no more workers start here, else empty. ``lost`` has the
    items of each job that was lost since the last answer.
    """

    name: str
    make: Callable[[], ThreadWorker]
    work: Work = Work.MATCH
    minibatch: int = 1  # pairs of a job of matching
    worker: ThreadWorker | None = None
    job: Job | None = None
    is_loaded: bool = False
    lost: list[frozenset[Item]] = field(default_factory=list)
    failed_starts: int = 0  # since the last answer
    closed: str = ""
    since: float = 0.0
    limit: float = -inf  # in the past: a worker may start at once

    @property
    def is_idle(self) -> bool:
        return self.is_loaded and self.job is None

    @property
    def is_starting(self) -> bool:
        """Return whether a worker is loading, or will be started again after a pause."""
        has_begun = self.worker is not None or bool(self.lost) or self.failed_starts > 0
        return has_begun and not self.is_loaded and not self.closed

    def may_start(self, now: float) -> bool:
        return self.worker is None and not self.closed and now >= self.limit

    def start(self, now: float, timeout: float) -> None:
        """Start a worker. Its first answer says whether it is loaded."""
        self.since = now
        self.limit = now + timeout
        self.worker = self.make()
        self.worker.start()

    def submit(self, job: Job, time_limit: float, now: float) -> None:
        """Hand a job to the idle worker."""
        assert self.worker is not None
        self.job = job
        self.since = now
        self.limit = now + time_limit
        self.worker.submit(job)

    def poll(self, now: float) -> Answer | None:
        """Return the worker's answer, or a :class:`Failure` if it hangs; ``None`` while it
        computes.
        """
        if self.worker is None:
            return None
        # An answer counts even after the limit: its work is done.
        answer = self.worker.answer()
        if answer is None and now >= self.limit:
            answer = Failure(Cause.TIMED_OUT, f"no answer for {now - self.since:.0f} s")
        if answer is None:
            return None
        self.limit = inf  # an idle worker may wait as long as it likes
        if isinstance(answer, Failure):
            self._fail(answer, now)
        elif isinstance(answer, Loaded):
            self.is_loaded = True
        else:
            self._note_answer()
        return answer

    def lose(
        self, items: Collection[Item], failure: Failure, now: float, given_up: Collection[Item]
    ) -> None:
        """Count a lost job, and close the place if it is at fault. ``given_up`` are items at fault.

        Without items, the job says nothing about its place, nor does any job of a place for scenes:
        each has a new process.
        """
        if items and self.work is not Work.SCENE:
            self.lost.append(frozenset(items))
            self._judge(failure, now, given_up)

    def kill(self) -> None:
        if self.worker is not None:
            self.worker.kill()
            self.worker = None
            self.is_loaded = False
            self.limit = -inf

    def _note_answer(self) -> None:
        self.lost = []
        self.failed_starts = 0

    def _fail(self, failure: Failure, now: float) -> None:
        """End the worker, unless only its job failed.

        After an out-of-memory error, memory stays fragmented. A failed device keeps failing.
        """
        if self.is_loaded and failure.cause is Cause.RAISED:
            self._note_answer()  # the worker and its device work
            return
        has_started = self.is_loaded
        self.kill()
        self.limit = now  # the next worker may start, unless the loop counts the job
        if not has_started:
            self.failed_starts += 1
            self._judge(failure, now, ())

    def _judge(self, failure: Failure, now: float, given_up: Collection[Item]) -> None:
        """Close the place after three losses in a row, or set the pause before the next worker."""
        losses = self.failed_starts + len(different(self.lost, given_up))
        # A refusal is an answer of the configuration, which no other worker would change.
        if losses >= MAX_LOSSES or failure.cause is Cause.REFUSED:
            self.closed = f"{self.name}: {failure}"
        self.limit = now + RESTART_PAUSE_S * losses


class Site:
    """The places of a run. Matching may run on other machines; estimates and scenes run next to the
    store.

    ``fallback`` are the matching places that take over when all others are closed. Workers call ``ring`` when an
    answer is ready, and their processes print to ``log``.
    """

    matching_cores = 0  # that are used by the workers of matching on this machine

    def __init__(
        self,
        clock: Callable[[], float],
        *,
        threads: bool = False,
        log: Path | None = None,
    ) -> None:
        self._clock = clock
        # One queue for all workers, so the loop waits for whichever answers first.
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._worker = ThreadWorker if threads else ProcessWorker
        self._log = log
        self._cores = available_cores()
        # In this process, a second thread would take its time from the thread that matches.
        estimators = 1 if threads else max(1, self._cores // CORES_PER_ESTIMATOR)
        make = partial(estimates_runner, in_process=not threads)
        self.places = [
            Place(f"estimates {n}", partial(self._make, "estimates", make), Work.ESTIMATE)
            for n in range(estimators)
        ]
        self.places += [
            Place("scenes" if n == 0 else f"scenes {n}", self.scene_worker, Work.SCENE)
            for n in range(self._cores)
        ]
        self.fallback: list[Place] = []

    def _make(self, name: str, make: Maker) -> ThreadWorker:
        worker = self._worker(name, make, self.ring)
        worker.log = self._log
        return worker

    def scenes_at_a_time(self, *, is_matching: bool) -> int:
        """Return the number of cores for scenes: the ones that matching leaves free, at least one."""
        return max(1, self._cores - self.matching_cores * is_matching)

    def printed(self) -> Path | None:
        """Return the log file of the workers' output, if it is not empty."""
        with suppress(OSError):  # it does not exist if nothing was printed
            if self._log is not None and self._log.stat().st_size:
                return self._log
        return None

    def of(self, work: Work) -> list[Place]:
        return [place for place in self.places if place.work is work]

    def open(self) -> None:
        """Add places for matching. Raise :class:`mkpc_kaggle.errors.UserError` if none is possible."""

    def fall_back(self) -> None:
        """Let the fallback places take over matching."""
        for place in self.of(Work.MATCH):
            place.kill()
            self.places.remove(place)
        self.places += self.fallback
        self.fallback = []
        self.matching_cores = self._cores  # the CPU computes now

    def scene_worker(self) -> ThreadWorker:
        """Return a worker for a scene, always in a process, since pycolmap may crash."""
        worker = ProcessWorker("scene", scene_runner, self.ring)
        worker.log = self._log
        return worker

    def ring(self) -> None:
        self._bell.put(None)

    def wait(self, until: float) -> None:
        """Wait until an answer or an interrupt may have arrived, at most until ``until`` on the
        engine's clock.
        """
        with suppress(queue.Empty):
            self._bell.get(timeout=max(0.0, min(LISTEN_S, until - self._clock())))

    def close(self) -> None:
        """Release the site, after its workers have been killed."""


class LocalSite(Site):
    """Places of this machine: ``workers`` processes, by default one per device; 0: a thread of this
    process.
    """

    def __init__(
        self,
        assembly: Assembly,
        workers: int | None,
        clock: Callable[[], float],
        log: Path | None = None,
    ) -> None:
        super().__init__(clock, threads=workers == 0, log=log)
        devices = assembly.devices
        # On a CPU, the workers share all cores. A GPU keeps one core busy.
        self.matching_cores = self._cores
        if workers == 0:
            self.places.append(self._place("this process", assembly))
            return
        # On a CPU, one process uses all threads. Two with half the threads each are faster (recipe
        # light, two cores: a sweep of 22 s, not 31 s). But they need twice the memory, and change
        # networks' last bits.
        used = [devices[number % len(devices)] for number in range(workers or len(devices))]
        for number, device in enumerate(used):
            count = used.count(device)
            name = device if count == 1 else f"{device} {number}"
            self.places.append(self._place(name, assembly.on(device, count), len(used)))
        if devices != ("cpu",):
            self.matching_cores = len(used)
            self.fallback = [self._place("cpu", assembly.on_cpu())]

    def _place(self, name: str, assembly: Assembly, share: int = 1) -> Place:
        # A thread of the user's process leaves the process's limits as they are.
        is_process = self._worker is ProcessWorker
        pipeline = partial(Pipeline.of, assembly)
        make = partial(MatchRunner, pipeline, share=share, is_limited=is_process)
        worker = partial(self._make, f"mkpc {name}", make)
        return Place(name, worker, minibatch=assembly.minibatch)
