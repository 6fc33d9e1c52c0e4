"""Places of workers. A place has one worker at a time.

A hung worker ends here: :meth:`Place.poll` kills a worker that has not answered in time
(:func:`mkpc_kaggle.engine.budget.time_limit`).
"""

import queue
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path

from mkpc_kaggle.cores import available_cores, limit_matching_threads
from mkpc_kaggle.engine.process import ProcessWorker, ThreadWorker
from mkpc_kaggle.engine.request import Answer, Cause, Failure, Job, Loaded
from mkpc_kaggle.engine.worker import MatchRunner, estimates_runner, scene_runner
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.setup.assembly import Assembly

LISTEN_S = 0.2  # between checks for an interrupt, since a signal does not ring
# An estimate takes a fraction of a pair's matching on a CPU; on a GPU, the other cores decode images.
CORES_PER_ESTIMATOR = 4


class Kind(StrEnum):
    """The work of a place's workers."""

    MATCH = "matching"
    ESTIMATE = "estimates"
    SCENE = "scenes"


@dataclass(eq=False)
class Place:
    """A place such as "cuda:0", with its worker and the worker's job, which began at ``since``.

    ``strikes`` and ``lost`` are of the losses since the last answer that count against it, and of all, each
    with the numbers of the units that are blamed for it.
    ``closed`` is the reason why no more workers start here, else empty. Times are of the engine's clock.
    """

    name: str
    make: Callable[[], ThreadWorker]
    kind: Kind = Kind.MATCH
    minibatch: int = 1  # pairs of a job of matching
    worker: ThreadWorker | None = None
    job: Job | None = None
    is_loaded: bool = False
    answers: int = 0  # to jobs
    strikes: int = 0
    lost: list[tuple[Job, list[int]]] = field(default_factory=list)
    closed: str = ""
    since: float = 0.0

    @property
    def is_idle(self) -> bool:
        return self.worker is not None and self.is_loaded and self.job is None

    def may_start(self, now: float) -> bool:
        # After two losses in a row it waits a second: scarce memory may become free meanwhile.
        has_waited = now >= self.since + (self.strikes > 1)
        return self.worker is None and not self.closed and has_waited

    def start(self, now: float) -> None:
        """Start a worker. Its first answer says whether it is loaded."""
        self.is_loaded = False
        self.since = now
        self.worker = self.make()
        self.worker.start()

    def submit(self, job: Job, now: float) -> None:
        """Hand a job to the idle worker, or to one that starts now."""
        if self.worker is None:
            self.start(now)
        assert self.worker is not None
        self.job = job
        self.since = now
        self.worker.submit(job)

    def poll(self, now: float, seconds: float) -> Answer | None:
        """Return the worker's answer, or a :class:`Failure` if it did not answer within ``seconds``; ``None``
        while it computes, and without a worker.

        A failure ends the worker, unless only its job failed. After an out-of-memory error, memory stays
        fragmented, and a failed device keeps failing.
        """
        if self.worker is None:
            return None
        # An answer counts even after the limit: its work is done.
        answer = self.worker.answer()
        if answer is None and not self.is_idle and now >= self.since + seconds:
            answer = Failure(Cause.TIMED_OUT, f"no answer for {now - self.since:.0f} s")
        if isinstance(answer, Loaded):
            self.is_loaded = True
            self.since = now
        elif isinstance(answer, Failure) and not (
            self.is_loaded and answer.cause is Cause.RAISED
        ):
            self.kill()
        return answer

    def note_answer(self) -> None:
        """Note that the worker works: it answered a job, if only by an ordinary error."""
        self.answers += 1
        self.strikes = 0
        self.lost = []

    def kill(self) -> None:
        if self.worker is not None:
            self.worker.kill()
            self.worker = None


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
        self.ring = partial(self._bell.put, None)
        self._worker = ThreadWorker if threads else ProcessWorker
        self._log = log
        self._cores = available_cores()
        # In this process, a second thread would take its time from the thread that matches.
        estimators = 1 if threads else max(1, self._cores // CORES_PER_ESTIMATOR)
        make = partial(estimates_runner, in_process=not threads)
        worker = partial(self._worker, "estimates", make, self.ring, log)
        self.places = [
            Place(f"estimates {n}", worker, Kind.ESTIMATE) for n in range(estimators)
        ]
        self.places += [
            Place(f"scenes {n}", self.scene_worker, Kind.SCENE) for n in range(self._cores)
        ]
        self.fallback: list[Place] = []

    def scene_worker(self) -> ThreadWorker:
        """Return a worker for a scene, always in a process, since pycolmap may crash."""
        return ProcessWorker("scene", scene_runner, self.ring, self._log)

    def of(self, kind: Kind) -> list[Place]:
        """Return the places of a kind that are not closed."""
        return [place for place in self.places if place.kind is kind and not place.closed]

    def free(self, now: float) -> list[Place]:
        """Return the places that can take a job: those with an idle worker, then those that may start one."""
        places = [place for place in self.places if place.is_idle]
        return places + [place for place in self.places if place.may_start(now)]

    def has_other(self, place: Place) -> bool:
        """Return whether another place can do what a place for matching does."""
        return bool(self.fallback) or self.of(Kind.MATCH) != [place]

    @property
    def has_jobs(self) -> bool:
        return any(place.job for place in self.places)

    @property
    def is_closed(self) -> bool:
        """No worker of matching is started any more."""
        return not self.of(Kind.MATCH)

    @property
    def reason(self) -> str:
        """Why places for matching are closed; empty if none is."""
        return "; ".join(
            place.closed for place in self.places if place.closed and place.kind is Kind.MATCH
        )

    @property
    def scenes_beside(self) -> int:
        """The number of scenes next to matching: the cores that it leaves free, at least one."""
        return max(1, self._cores - self.matching_cores)

    def fall_back(self) -> None:
        """Let the fallback places take over matching."""
        for place in [place for place in self.places if place.kind is Kind.MATCH]:
            place.kill()
            self.places.remove(place)
        self.places += self.fallback
        self.fallback = []
        self.matching_cores = self._cores  # the CPU computes now

    def wait(self, until: float) -> None:
        """Wait until an answer or an interrupt may have arrived, at most until ``until`` on the
        engine's clock.
        """
        with suppress(queue.Empty):
            self._bell.get(timeout=max(0.0, min(LISTEN_S, until - self._clock())))

    def close(self) -> None:
        """End all workers."""
        for place in [*self.places, *self.fallback]:
            place.kill()


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
        # The limits of the user's process stay as they are.
        is_process = self._worker is ProcessWorker
        limit = partial(limit_matching_threads, share=share) if is_process else None
        make = partial(MatchRunner, partial(Pipeline.of, assembly), limit)
        worker = partial(self._worker, f"mkpc {name}", make, self.ring, self._log)
        return Place(name, worker, minibatch=assembly.minibatch)
