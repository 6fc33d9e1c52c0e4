"""The two halves of a job: matching, where the device is, and the estimation of F, where the engine is."""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.data.images import ImageStore, Unreadable
from mkpc_kaggle.engine.jobs import NOT_REACHED, Finished, Job, Matched, Outcome, Plan, Record, Task, record_of
from mkpc_kaggle.pipeline.stages import PairWork, Pipeline, UnitResult, conclude
from mkpc_kaggle.recipe import Recipe, Unit


class OutOfMemoryError(Exception):
    """A unit did not have memory enough."""


@dataclass(frozen=True, eq=False)
class Opened:
    """A task with its images decoded, or why they cannot be; ``seconds`` were spent waiting for them."""

    work: PairWork | None
    seconds: float
    failure: str = ""


class Bench:
    """Where pairs are matched: a pipeline and the images at hand. Only :meth:`match` computes."""

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

    def forget(self) -> None:
        """Let go of the matchers and all that they remember; they are loaded again when they are needed."""
        self._pipeline = None

    def announce(self, paths: Iterable[Path]) -> None:
        """Decode these ahead, in the background."""
        self._images.announce(paths)

    def match(self, job: Job, seconds: float, alive: Callable[[], None] = lambda: None) -> tuple[Matched, ...]:
        """First half of a job: no unit is begun that is expected to end later than ``seconds`` from now.

        ``alive`` is called before each unit on each batch of pairs. Raises :class:`OutOfMemoryError`.
        """
        pipeline, plan = self.load(), job.plan
        deadline = time.monotonic() + seconds
        units = {unit.shrunk(plan.shrink) if plan.shrink < 1 else unit: unit for unit in plan.units}
        expected = dict(zip(units, plan.expected, strict=True))

        def keep_on(unit: Unit) -> bool:
            alive()
            return not self._stopped.is_set() and time.monotonic() + expected[unit] < deadline

        opened = [self._open(task) for task in job.tasks]
        # A stand-in for a unit is no other unit: what a pair has had is left out here.
        wanted = [unit for unit in units if not all(has(task, units[unit]) for task in job.tasks)]
        matched = iter(pipeline.match([one.work for one in opened if one.work], wanted, keep_on))
        done = [replace(one, work=next(matched)) if one.work else one for one in opened]
        return tuple(_matched(task, one, units, plan) for task, one in zip(job.tasks, done, strict=True))

    def stop(self) -> None:
        """Begin no further unit."""
        self._stopped.set()

    def close(self) -> None:
        self.stop()
        self._images.close()

    def _open(self, task: Task) -> Opened:
        start = time.perf_counter()
        image0, image1 = (self._images.get(path) for path in task.pair.images)
        seconds = time.perf_counter() - start
        if isinstance(image0, Unreadable):
            return Opened(None, seconds, str(image0))
        if isinstance(image1, Unreadable):
            return Opened(None, seconds, str(image1))
        return Opened(PairWork((image0, image1), task.results), seconds)


def has(task: Task, unit: Unit) -> bool:
    return any(result.unit == unit for result in task.results)


def _matched(task: Task, opened: Opened, units: dict[Unit, Unit], plan: Plan) -> Matched:
    work = opened.work
    if work is None:
        return Matched(decode_seconds=opened.seconds, failure=opened.failure)
    new = work.results[len(task.results) :]
    short = next((result for result in new if result.exhausted), None)
    if short is not None:
        raise OutOfMemoryError(f"{units[short.unit].name}: {short.failure}")
    results = tuple(as_written(result, units[result.unit], plan) for result in new)
    return Matched(results, work.regions, work.sizes, opened.seconds, work.cluster_seconds)


def as_written(result: UnitResult, unit: Unit, plan: Plan) -> UnitResult:
    """The result under the name of the recipe's unit, with a note if the unit ran smaller than that."""
    return replace(result, unit=unit, failure=result.failure or plan.note)


def estimate(job: Job, matched: Iterable[Matched], recipe: Recipe) -> Finished:
    """Second half of a job: F from all matches of each pair."""
    return Finished(job, tuple(_outcome(task, one, recipe) for task, one in zip(job.tasks, matched, strict=True)))


def _outcome(task: Task, matched: Matched, recipe: Recipe) -> Outcome:
    if not matched.results or matched.sizes is None:
        return Outcome(Record.untouched(task.index, matched.failure or NOT_REACHED))
    start = time.perf_counter()
    match = conclude(
        task.results + matched.results,
        matched.regions,
        matched.sizes,
        recipe,
        task.pair.model,
        task.pair.intrinsics,
    )
    seconds = time.perf_counter() - start
    record = record_of(
        task.index,
        match,
        decode=matched.decode_seconds,
        cluster=matched.cluster_seconds,
        estimate=seconds,
    )
    return Outcome(record, matched.results)
