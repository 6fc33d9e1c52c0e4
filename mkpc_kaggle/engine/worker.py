"""What a worker does with its jobs, in whatever process it is: matching and F of pairs, the cameras of a batch."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Protocol

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, ImageStore
from mkpc_kaggle.engine.jobs import (
    Answer,
    Cause,
    Failure,
    Job,
    Loaded,
    MatchJob,
    MatchResult,
    Outcome,
    SceneJob,
    TaskJob,
)
from mkpc_kaggle.engine.records import NOT_REACHED, PairRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline import failures
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.reconstruct import Solution, reconstruct_batch

ESTIMATE_THREADS = 2  # OpenCV releases the interpreter's lock: F of pairs is estimated while the next are matched

CAUSES = {
    failures.FailureKind.OUT_OF_MEMORY: Cause.OUT_OF_MEMORY,
    failures.FailureKind.DEVICE: Cause.DEVICE,
    failures.FailureKind.ORDINARY: Cause.RAISED,
}


class Runner(Protocol):
    """Does jobs of one kind. It may raise anything, never return, or end the process."""

    def run(self, job: Job, seconds: float) -> Answer: ...


class Executor:
    """A worker's own side, in whatever process it is: it makes its runner, then does jobs. Neither raises."""

    runner: Runner

    def load(self, make: Callable[[], Runner]) -> Answer:
        try:
            self.runner = make()
        except UserError as error:
            is_device = isinstance(error, failures.DeviceError)
            return Failure(Cause.DEVICE if is_device else Cause.REFUSED, str(error))
        except Exception as error:
            return failure_of(error)
        return Loaded()

    def run(self, job: Job, seconds: float) -> Answer:
        try:
            return self.runner.run(job, seconds)
        except Exception as error:
            return failure_of(error)


def failure_of(error: Exception) -> Failure:
    return Failure(CAUSES[failures.failure_of(error)], failures.reason_of(error))


def use_threads(count: int) -> None:
    """Let this process compute in so many threads at a time."""
    import cv2
    import torch

    torch.set_num_threads(count)
    cv2.setNumThreads(count)


def share_cores(make: Callable[[], Runner], share: int) -> Runner:
    """What ``make`` makes in one of so many processes that share the machine's cores."""
    import torch

    if share > 1:
        use_threads(max(1, torch.get_num_threads() // share))
    return make()


class MatchRunner:
    """Matches the pairs of jobs and estimates their F, in threads, while the next minibatch is matched.

    Loads all matchers, unless it gets jobs without units alone; raises :class:`mkpc_kaggle.errors.UserError` where
    this fails.
    """

    def __init__(self, make_pipeline: Callable[[], Pipeline], *, load: bool = True) -> None:
        self._pipeline = make_pipeline()
        if load:
            self._pipeline.load()
        self._images = ImageStore()
        self._estimators = ThreadPoolExecutor(ESTIMATE_THREADS, thread_name_prefix="estimate")

    def run(self, job: Job, seconds: float) -> MatchResult:
        """Match the pairs of a job; no unit begins that is expected to end later than ``seconds`` from now."""
        assert isinstance(job, MatchJob)
        if not job.units:
            return self._estimate_anew(job)
        deadline = time.monotonic() + seconds
        expected = dict(zip(job.units, job.expected, strict=True))

        def may_start(unit: Unit) -> bool:
            return time.monotonic() + expected[unit] < deadline

        self._images.prefetch(path for pair in job.pairs for path in pair.images)
        pairs = [self._open(pair, known) for pair, known in zip(job.pairs, job.known, strict=True)]
        readable = [number for number, pair in enumerate(pairs) if not pair.failure]
        estimates: list[Future[Outcome]] = []
        for start in range(0, len(readable), self._pipeline.minibatch):
            part = readable[start : start + self._pipeline.minibatch]
            found = self._pipeline.match([pairs[number] for number in part], job.units, may_start)
            estimates += [
                self._estimators.submit(self._estimate, job, *pair) for pair in zip(part, found, strict=True)
            ]
        outcomes = [Outcome(PairRecord.untouched(i, p.failure)) for i, p in zip(job.indices, pairs, strict=True)]
        for number, estimate in zip(readable, estimates, strict=True):
            outcomes[number] = estimate.result()
        return MatchResult(tuple(outcomes))

    def _estimate_anew(self, job: MatchJob) -> MatchResult:
        """F of the pairs of a job from what is known of them; their images are not looked at."""
        estimates = [self._estimators.submit(self._record, job, *pair) for pair in enumerate(job.known)]
        return MatchResult(tuple(Outcome(estimate.result()) for estimate in estimates))

    def _open(self, pair: Pair, known: PairMatch) -> PairMatch:
        """The pair with its images; ``failure`` says which of them cannot be read."""
        start = time.perf_counter()
        files = zip(pair.images, pair.turns, strict=True)
        images = [self._images.get(path).turned(turns) for path, turns in files]
        seconds = time.perf_counter() - start
        readable = tuple(image for image in images if isinstance(image, Image))
        failure = next((str(image) for image in images if not isinstance(image, Image)), "")
        return replace(known, images=readable, failure=failure, decode_seconds=seconds)

    def _estimate(self, job: MatchJob, number: int, pair: PairMatch) -> Outcome:
        """F from all matches of a pair; the outcome has the new results alone, since only these have to travel."""
        found = pair.results[len(job.known[number].results) :]
        if not found:
            return Outcome(PairRecord.untouched(job.indices[number], NOT_REACHED))
        sizes = tuple(image.size for image in pair.images)
        versions = tuple(image.version for image in pair.images)
        focals = tuple(image.focal for image in pair.images)
        pair = replace(pair, images=(), sizes=sizes, versions=versions, focals=focals)
        return Outcome(self._record(job, number, pair), found)

    def _record(self, job: MatchJob, number: int, pair: PairMatch) -> PairRecord:
        start, recipe, asked = time.perf_counter(), self._pipeline.recipe, job.pairs[number]
        pair = with_estimate(pair, recipe, asked.model, asked.intrinsics)
        pair = replace(pair, estimate_seconds=time.perf_counter() - start)
        return PairRecord.of(job.indices[number], pair, recipe.pair_estimation(asked.intrinsics))


class SceneRunner:
    """Reconstructs batches. pycolmap may end the process: see :mod:`mkpc_kaggle.scene.colmap`."""

    def run(self, job: Job, seconds: float) -> Solution:
        """The cameras of a batch, and which F each of its pairs gets; ``seconds`` are not looked at."""
        assert isinstance(job, SceneJob) and job.recipe.scene is not None
        return reconstruct_batch(job.pairs, job.recipe.scene, job.recipe.focal, job.recipe.magsac, job.export)


class TaskRunner:
    """Looks at images before there are pairs."""

    def run(self, job: Job, seconds: float) -> bytes:
        assert isinstance(job, TaskJob)
        return job.do()
