"""A pool of one worker that lives in the engine's own process: for one's own matchers, notebooks and tests."""

import queue
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from mkpc_kaggle.engine.jobs import Cause, Finished, Job, Lost
from mkpc_kaggle.engine.worker import Bench, estimate
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe

JOBS_A_WORKER = 2
"""One is matched while F is estimated for the one before it; the next waits."""


class InProcessPool:
    """Matching in one thread, F of the pairs matched before in another, decoding ahead in a third.

    OpenCV and torch release the interpreter's lock while they compute, so that the three overlap. A matcher
    that never returns cannot be stopped here, nor one that brings the process down, and a device that failed
    does not come back: that takes processes.
    """

    def __init__(self, make_pipeline: Callable[[], Pipeline], recipe: Recipe) -> None:
        self._bench = Bench(make_pipeline)
        self._recipe = recipe
        self._matching = ThreadPoolExecutor(1, thread_name_prefix="match")
        self._estimating = ThreadPoolExecutor(1, thread_name_prefix="estimate")
        self._back: queue.SimpleQueue[Finished | Lost] = queue.SimpleQueue()
        self._out = 0
        self._device_failed = False

    @property
    def workers(self) -> int:
        return int(not self._device_failed)

    @property
    def capacity(self) -> int:
        return JOBS_A_WORKER * self.workers

    def start(self) -> str:
        self._matching.submit(self._bench.load).result()
        return ""

    def submit(self, job: Job) -> None:
        self._out += 1
        self._bench.announce(path for task in job.tasks for path in task.pair.images)
        self._matching.submit(self._match, job)

    def next(self, until: float) -> Finished | Lost | None:
        try:
            back = self._back.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            return None
        self._out -= 1
        return back

    def stop(self) -> None:
        self._bench.stop()

    def close(self) -> bool:
        self._bench.close()
        idle = self._out == 0
        self._matching.shutdown(wait=idle)
        self._estimating.shutdown(wait=idle)
        return idle

    def _match(self, job: Job) -> None:
        try:
            matched = self._bench.match(job, job.plan.deadline - time.monotonic())
            self._estimating.submit(self._estimate, job, matched)
        except Exception as error:
            lost = lost_by(job, error)
            if lost.cause is Cause.OUT_OF_MEMORY:
                self._bench.forget()
            self._device_failed |= lost.cause is Cause.DEVICE
            self._back.put(lost)

    def _estimate(self, job: Job, matched: tuple) -> None:  # type: ignore[type-arg]
        try:
            self._back.put(estimate(job, matched, self._recipe))
        except Exception as error:
            self._back.put(lost_by(job, error))


def lost_by(job: Job, error: Exception) -> Lost:
    """What an error makes of a job."""
    causes = {
        Failure.OUT_OF_MEMORY: Cause.OUT_OF_MEMORY,
        Failure.DEVICE: Cause.DEVICE,
        Failure.ORDINARY: Cause.RAISED,
    }
    return Lost(job, causes[failure_of(error)], reason_of(error))
