"""The two halves of a job: matching, where the device is, and the estimation of F, where the engine is."""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, ImageStore
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure, JobResult, Outcome
from mkpc_kaggle.engine.records import NOT_REACHED, PairRecord
from mkpc_kaggle.pipeline.failures import Failure, failure_of, reason_of
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe, Unit

Answer = tuple[PairMatch, ...] | JobFailure
"""What a worker makes of a job: for each pair what this job found on it, or why there is nothing."""

CAUSES = {Failure.OUT_OF_MEMORY: Cause.OUT_OF_MEMORY, Failure.DEVICE: Cause.DEVICE, Failure.ORDINARY: Cause.RAISED}


class Worker:
    """Matches the pairs of jobs: a pipeline, loaded when it is first needed, and the images at hand."""

    def __init__(self, make_pipeline: Callable[[], Pipeline], images: ImageStore | None = None) -> None:
        self._make_pipeline = make_pipeline
        self._pipeline: Pipeline | None = None
        self._images = images or ImageStore()
        self._stopped = threading.Event()

    def load(self) -> Pipeline:
        """Load all matchers; raises :class:`mkpc_kaggle.errors.UserError` where one cannot be."""
        if self._pipeline is None:
            self._pipeline = self._make_pipeline()
            self._pipeline.load()
        return self._pipeline

    def prefetch(self, paths: Iterable[Path]) -> None:
        """Decode these ahead, in the background."""
        self._images.prefetch(paths)

    def run(self, job: Job, seconds: float, heartbeat: Callable[[], None] = lambda: None) -> Answer:
        """Match the pairs of a job; no unit is begun that is expected to end later than ``seconds`` from now.

        ``heartbeat`` is called before each unit on each batch of pairs. Never raises.
        """
        try:
            return self._match(job, seconds, heartbeat)
        except Exception as error:
            return failed(job, error)

    def stop(self) -> None:
        """Begin no further unit."""
        self._stopped.set()

    def close(self) -> None:
        self.stop()
        self._images.close()

    def _match(self, job: Job, seconds: float, heartbeat: Callable[[], None]) -> tuple[PairMatch, ...]:
        pipeline = self.load()
        deadline = time.monotonic() + seconds
        units = {unit: unit for unit in job.units}
        expected = dict(zip(units, job.expected, strict=True))

        def may_start(unit: Unit) -> bool:
            heartbeat()
            return not self._stopped.is_set() and time.monotonic() + expected[unit] < deadline

        opened = [self._open(pair, known) for pair, known in zip(job.pairs, job.known, strict=True)]
        wanted = [unit for unit in units if not all(pair.has(units[unit]) for pair in opened)]
        matched = iter(pipeline.match([pair for pair in opened if not pair.failure], wanted, may_start))
        done = [pair if pair.failure else next(matched) for pair in opened]
        return tuple(_found(pair, known, units, job) for pair, known in zip(done, job.known, strict=True))

    def _open(self, pair: Pair, known: tuple[UnitResult, ...]) -> PairMatch:
        """The pair with its images; ``failure`` says which of them cannot be read."""
        start = time.perf_counter()
        images = tuple(self._images.get(path) for path in pair.images)
        seconds = time.perf_counter() - start
        readable = tuple(image for image in images if isinstance(image, Image))
        failure = next((str(image) for image in images if not isinstance(image, Image)), "")
        return PairMatch(known, images=readable, failure=failure, decode_seconds=seconds)


def _found(pair: PairMatch, known: tuple[UnitResult, ...], units: dict[Unit, Unit], job: Job) -> PairMatch:
    """What a job found on a pair, without what was known before: that is all that has to travel."""
    results = tuple(
        replace(result, unit=units[result.unit], failure=result.failure or job.note)
        for result in pair.results[len(known) :]
    )
    sizes = tuple(image.size for image in pair.images)
    versions = tuple(image.version for image in pair.images)
    return replace(pair, results=results, images=(), sizes=sizes, versions=versions)


def failed(job: Job, error: Exception) -> JobFailure:
    """What an error makes of a job."""
    return JobFailure(job, CAUSES[failure_of(error)], reason_of(error))


def estimate(job: Job, found: Iterable[PairMatch], recipe: Recipe) -> JobResult | JobFailure:
    """Second half of a job: F from all matches of each pair. Never raises."""
    try:
        pairs = zip(job.indices, job.pairs, job.known, found, strict=True)
        return JobResult(job, tuple(_outcome(*one, recipe) for one in pairs))
    except Exception as error:
        return failed(job, error)


def _outcome(index: int, pair: Pair, known: tuple[UnitResult, ...], found: PairMatch, recipe: Recipe) -> Outcome:
    if not found.results:
        return Outcome(PairRecord.untouched(index, found.failure or NOT_REACHED))
    start = time.perf_counter()
    whole = replace(found, results=known + found.results)
    match = with_estimate(whole, recipe, pair.model, pair.intrinsics)
    match = replace(match, estimate_seconds=time.perf_counter() - start)
    return Outcome(PairRecord.of(index, match), found.results)
