"""Workers: where jobs are done. This one lives in the engine's own process, in threads of its own."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol

from mkpc_kaggle.images import ImageStore, Unreadable
from mkpc_kaggle.pipeline import PairWork, Pipeline, finish
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.run.jobs import NOT_REACHED, Job, JobResult, Outcome, Record, Task, record_of


class Worker(Protocol):
    """Does jobs one after the other; several may wait for it."""

    def start(self) -> None:
        """Get ready to work; raises :class:`mkpc_kaggle.errors.UserError` where that cannot be."""
        ...

    def submit(self, job: Job) -> "Future[JobResult]": ...

    def stop(self) -> None:
        """Begin no further unit: jobs under way and those that wait end with what they have."""
        ...

    def close(self) -> bool:
        """Let go of everything; false where something is still running and cannot be stopped."""
        ...


@dataclass(frozen=True, eq=False)
class Opened:
    """A task with its images decoded, or why they cannot be; ``seconds`` were spent waiting for them."""

    work: PairWork | None
    seconds: float
    failure: str = ""


class InProcessWorker:
    """Matching in one thread, F of the pairs matched before in another, decoding ahead in a third.

    OpenCV and torch release the interpreter's lock while they compute, so that the three overlap.
    """

    def __init__(self, make_pipeline: Callable[[], Pipeline], estimators: int = 1) -> None:
        self._make_pipeline = make_pipeline
        self._pipeline: Pipeline | None = None
        self._images = ImageStore()
        self._matching = ThreadPoolExecutor(1, thread_name_prefix="match")
        self._estimating = ThreadPoolExecutor(estimators, thread_name_prefix="estimate")
        self._stopped = threading.Event()
        self._open_jobs: set[Future[JobResult]] = set()

    def start(self) -> None:
        self._matching.submit(self._load).result()

    def submit(self, job: Job) -> "Future[JobResult]":
        self._images.announce(path for task in job.tasks for path in task.pair.images)
        done: Future[JobResult] = Future()
        self._open_jobs.add(done)
        done.add_done_callback(self._open_jobs.discard)
        self._matching.submit(self._match, job, done)
        return done

    def stop(self) -> None:
        self._stopped.set()

    def close(self) -> bool:
        self.stop()
        self._images.close()
        idle = not self._open_jobs
        self._matching.shutdown(wait=idle)
        self._estimating.shutdown(wait=idle)
        return idle

    def _load(self) -> Pipeline:
        if self._pipeline is None:
            self._pipeline = self._make_pipeline()
            self._pipeline.load()
        return self._pipeline

    def _match(self, job: Job, done: "Future[JobResult]") -> None:
        """First half of a job, in the matching thread."""
        try:
            pipeline = self._load()
            expected = dict(zip(job.units, job.expected, strict=True))

            def keep_on(unit: Unit) -> bool:
                return not self._stopped.is_set() and time.monotonic() + expected[unit] < job.deadline

            opened = [self._open(task) for task in job.tasks]
            matched = iter(pipeline.match([one.work for one in opened if one.work], job.units, keep_on))
            opened = [replace(one, work=next(matched)) if one.work else one for one in opened]
            self._estimating.submit(self._estimate, pipeline.recipe, job, opened, done)
        except BaseException as error:
            done.set_exception(error)

    def _open(self, task: Task) -> Opened:
        start = time.perf_counter()
        image0, image1 = (self._images.get(path) for path in task.pair.images)
        seconds = time.perf_counter() - start
        if isinstance(image0, Unreadable):
            return Opened(None, seconds, str(image0))
        if isinstance(image1, Unreadable):
            return Opened(None, seconds, str(image1))
        return Opened(PairWork((image0, image1), task.results), seconds)

    def _estimate(self, recipe: Recipe, job: Job, opened: list[Opened], done: "Future[JobResult]") -> None:
        """Second half of a job, in the estimating thread, while the next job is matched."""
        try:
            outcomes = [_outcome(task, one, recipe) for task, one in zip(job.tasks, opened, strict=True)]
            done.set_result(JobResult(job, tuple(outcomes)))
        except BaseException as error:
            done.set_exception(error)


def _outcome(task: Task, opened: Opened, recipe: Recipe) -> Outcome:
    work = opened.work
    if work is None or not work.results:
        return Outcome(Record.untouched(task.index, opened.failure or NOT_REACHED))
    start = time.perf_counter()
    match = finish(work, recipe, task.pair.model, task.pair.intrinsics)
    seconds = time.perf_counter() - start
    record = record_of(task.index, match, decode=opened.seconds, cluster=work.cluster_seconds, estimate=seconds)
    return Outcome(record, match.results)
