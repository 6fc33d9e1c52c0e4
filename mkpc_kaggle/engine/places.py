"""Where workers are: a place has one worker at a time, and is closed when it loses three in a row."""

import queue
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import inf

from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job, Loaded, MatchJob
from mkpc_kaggle.engine.process import ProcessWorker, ThreadWorker
from mkpc_kaggle.engine.worker import MatchRunner, SceneRunner, share_cores
from mkpc_kaggle.pipeline.assembly import Assembly

START_TIMEOUT_S = 300.0  # for a worker to load its matchers; over a network's disk that is not quick
RESTART_PAUSE_S = 1.0  # times the workers lost in a row: memory that is short may be free again
MAX_LOSSES = 3  # workers lost in a row, with no answer between, close a place
LISTEN_S = 0.2  # how often an interrupt is looked for


@dataclass(eq=False)
class Place:
    """A place such as "cuda:0": its worker, the job that this has, and until when its answer is waited for.

    ``closed`` says why no worker is started here any more.
    """

    name: str
    make: Callable[[], ThreadWorker]
    worker: ThreadWorker | None = None
    job: Job | None = None
    is_loaded: bool = False
    losses: int = 0
    closed: str = ""
    since: float = 0.0
    limit: float = inf

    @property
    def is_idle(self) -> bool:
        return self.is_loaded and self.job is None

    @property
    def is_starting(self) -> bool:
        """Whether a worker is being loaded, or may be after a pause."""
        return not self.is_loaded and not self.closed and (self.worker is not None or self.losses > 0)

    def may_start(self, now: float) -> bool:
        return self.worker is None and not self.closed and (now >= self.limit or not self.losses)

    def start(self, now: float, timeout: float = START_TIMEOUT_S) -> None:
        """Start a worker; it is loaded when it says so."""
        self.is_loaded, self.since, self.limit = False, now, now + timeout
        self.worker = self.make()
        self.worker.start()

    def submit(self, job: Job, seconds: float, time_limit: float, now: float) -> None:
        """Hand a job to the idle worker; its units may begin within ``seconds``."""
        assert self.worker is not None
        self.job, self.since, self.limit = job, now, now + time_limit
        self.worker.submit(job, seconds)

    def poll(self, now: float) -> Answer | None:
        """What the worker answers, or that it hangs; then it is idle, or killed. ``None`` while it is at work."""
        if self.worker is None:
            return None
        answer = self.worker.answer()
        if answer is None and now >= self.limit:
            answer = Failure(Cause.TIMED_OUT, f"no answer for {now - self.since:.0f} s")
        if answer is None:
            return None
        self.limit = inf
        if isinstance(answer, Loaded):
            self.is_loaded = True
            return answer
        if self.is_loaded and not (isinstance(answer, Failure) and answer.cause.is_of_place):
            self.losses = 0
        if isinstance(answer, Failure) and (answer.cause is not Cause.RAISED or not self.is_loaded):
            self._lose(answer, now)
        return answer

    def kill(self) -> None:
        worker, self.worker, self.job, self.is_loaded = self.worker, None, None, False
        if worker is not None:
            worker.kill()

    def _lose(self, failure: Failure, now: float) -> None:
        """End the worker: memory that ran out is fragmented, and a device that failed goes on failing.

        A death or a hang at a job that another worker was lost at does not count against the place.
        """
        job, was_loaded = self.job, self.is_loaded
        self.kill()
        self.job, self.limit = job, now
        is_retry = isinstance(job, MatchJob) and job.is_retry and failure.cause in (Cause.DIED, Cause.TIMED_OUT)
        if not was_loaded or (failure.cause.is_of_place and not is_retry):
            self.losses += 1
            self.limit = now + RESTART_PAUSE_S * self.losses
            if self.losses >= MAX_LOSSES or failure.cause is Cause.REFUSED:
                self.closed = f"{self.name}: {failure}"


class Site:
    """A machine or a cluster: the places of its matching workers, and where batches are reconstructed.

    ``fallback`` are the places where the work goes on when ``places`` are closed. Workers call ``ring`` when an
    answer is there.
    """

    scenes_at_once = 1
    loads_matchers = True  # False: jobs have no units

    def __init__(self, clock: Callable[[], float]) -> None:
        self.places: list[Place] = []
        self.fallback: list[Place] = []
        self._clock = clock
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()

    def open(self) -> None:
        """Make the places known; raises :class:`mkpc_kaggle.errors.UserError` where there can be none."""

    def match_runner(self, assembly: Assembly) -> Callable[[], MatchRunner]:
        """What a worker for pairs makes its runner with."""
        return partial(MatchRunner, assembly.pipeline, load=self.loads_matchers)

    def scene_worker(self) -> ThreadWorker:
        return ProcessWorker("scene", SceneRunner, self.ring)

    def ring(self) -> None:
        self._bell.put(None)

    def wait(self, until: float) -> None:
        """Until an answer may be there, or an interrupt, or the time ``until`` of the engine's clock."""
        with suppress(queue.Empty):
            self._bell.get(timeout=max(0.0, min(LISTEN_S, until - self._clock())))

    def close(self) -> None:
        """Let go of the site; its workers have been killed."""


class LocalSite(Site):
    """A worker process for each device of the machine, or as many as asked for; 0: a thread of this process."""

    def __init__(self, assembly: Assembly, workers: int | None, clock: Callable[[], float]) -> None:
        super().__init__(clock)
        if workers == 0:
            runner = self.match_runner
            self.places = [Place("this process", lambda: ThreadWorker("matching", runner(assembly), self.ring))]
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
        def worker() -> ProcessWorker:
            make = partial(share_cores, self.match_runner(assembly), share)
            return ProcessWorker(f"mkpc {name}", make, self.ring)

        return Place(name, worker)
