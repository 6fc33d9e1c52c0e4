"""The work of workers: matching, estimates, reconstructions.

Importing this module does not import torch, which estimates and scenes do not need.
The threads of each worker are decided in :mod:`mkpc_kaggle.cores`.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from mkpc_kaggle.cores import limit_matching_threads, limit_to_one_thread
from mkpc_kaggle.data.images import Image, ImageStore
from mkpc_kaggle.engine.request import (
    Answer,
    Cause,
    Estimated,
    Failure,
    Job,
    Loaded,
    MatchJob,
    PairInputs,
    SceneJob,
    keys_of,
)
from mkpc_kaggle.errors import UserError, shown
from mkpc_kaggle.matchers import failures
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.candidates import batch_pair, candidate_settings, disagreement
from mkpc_kaggle.scene.models import models_of
from mkpc_kaggle.scene.sfm import Solution, reconstruct_batch

if TYPE_CHECKING:
    from mkpc_kaggle.pipeline.stages import Pipeline

Runner = Callable[[Job], Answer]  # it may raise anything, never return, or end the process
Maker = Callable[[], Runner]
Message = Maker | Job  # to a worker; the first is the maker of the worker's runner


class Executor:
    """The worker's side in any process. The first message makes the runner; all others are jobs.
    Never raises.
    """

    _run: Runner | None = None

    def answer(self, message: Message) -> Answer:
        try:
            if self._run is not None:
                return self._run(cast(Job, message))
            self._run = cast(Maker, message)()
        except Exception as error:
            # Before the first job, a user error means that the worker can never load.
            if self._run is None and isinstance(error, UserError):
                is_device = isinstance(error, failures.DeviceError)
                return Failure(Cause.DEVICE if is_device else Cause.REFUSED, str(error))
            return failure_of(error)
        return Loaded(getattr(self._run, "refused", {}))


def failure_of(error: Exception) -> Failure:
    return Failure(Cause[failures.failure_kind(error).name], failures.reason_of(error))


class MatchRunner:
    """A runner of match jobs. ``limit`` limits the threads of PyTorch and OpenCV.

    ``refused`` has the reason for each matcher that cannot be loaded: the run continues without its units. Raises
    :class:`mkpc_kaggle.errors.UserError` if none can be loaded.
    """

    def __init__(
        self,
        make_pipeline: Callable[[], "Pipeline"],
        limit: Callable[[], None] | None = limit_matching_threads,
    ) -> None:
        if limit is not None:
            limit()
        self._pipeline = make_pipeline()
        self._pipeline.load()
        self.refused = self._pipeline.unloadable
        self._images = ImageStore()

    def __call__(self, job: Job) -> tuple[PairMatch, ...]:
        """Match the pairs of a job with each unit that is expected to end in time."""
        assert isinstance(job, MatchJob)
        # Durations and not moments in the job: other machines have other clocks.
        deadline = time.monotonic() + job.plan.seconds
        expected = dict(zip(job.units, job.plan.expected, strict=True))

        def may_start(unit: Unit, pairs: int) -> bool:
            return time.monotonic() + pairs * expected[unit] < deadline

        opened = [self._open(*each) for each in with_points(job)]
        # Decoding the next pairs' images takes place while a GPU matches.
        self._images.prefetch(job.upcoming)
        # An unreadable image fails its pair alone, not the minibatch.
        readable = [pair for pair in opened if not pair.failure]
        matched = iter(self._pipeline.match(readable, job.units, may_start))
        done = [pair if pair.failure else next(matched) for pair in opened]
        # Without the given points, and without pixels
        return tuple(
            replace(pair, results=pair.results[len(given.points) :], images=())
            for pair, given in zip(done, job.pairs, strict=True)
        )

    def _open(self, inputs: PairInputs, given: tuple[UnitResult, ...]) -> PairMatch:
        """Return a pair with its images; ``failure`` names an image that is unreadable, or has changed."""
        images = []
        failure = ""
        pair = inputs.pair
        for path, turns, known in zip(pair.images, pair.turns, inputs.images, strict=True):
            image = self._images.get(path).turned(turns)
            if not isinstance(image, Image):
                failure = failure or str(image)
            # Otherwise wrong points would have a right key for ever.
            elif image.version != known.digest:
                failure = failure or f"{shown(path)}: changed during the run"
            else:
                images.append(image)
        return PairMatch(given, images=() if failure else tuple(images), failure=failure)


def estimates_runner(*, in_process: bool = True) -> Runner:
    """Return the runner of estimates. A separate process has one thread."""
    # The user's own process keeps its thread limits.
    if in_process:
        limit_to_one_thread()
    return do_estimates_job


def do_estimates_job(job: Job) -> tuple[Estimated, ...]:
    """Return the estimates of a job's pairs, each from its points of all units."""
    estimates = []
    for pair, results in with_points(job):
        start = time.perf_counter()
        # From the digested contents, so the images are not decoded again.
        sizes = tuple(image.size for image in pair.images)
        focals = tuple(image.focal for image in pair.images)
        match = with_estimate(PairMatch(results, sizes=sizes, focals=focals), job.recipe)
        facts = match.facts(pair.points.values())
        estimates.append(Estimated(facts, time.perf_counter() - start))
    return tuple(estimates)


def scene_runner() -> Runner:
    """Return the runner of a process that does one job: a scene."""
    return compute_scene


def compute_scene(job: Job) -> Solution:
    """Return the reconstructions of a batch, and a choice for each pair. pycolmap may end the
    process.
    """
    recipe = job.recipe
    assert isinstance(job, SceneJob) and recipe.scene is not None
    pairs = [
        batch_pair(pair.images, results, pair.own, job.candidate)
        for pair, results in with_points(job)
    ]
    solution = reconstruct_batch(
        pairs,
        candidate_settings(job.candidate, recipe.scene),
        recipe.focal,
        recipe.magsac,
        job.folder,
        cameras=job.cameras,
    )
    value = disagreement(pairs, models_of(solution.reconstructions))
    return replace(solution, disagreement=value)


def with_points(job: Job) -> list[tuple[PairInputs, tuple[UnitResult, ...]]]:
    """Return each pair of a job with the points of its units."""
    points = job.source.matches(keys_of(job.pairs))
    return [
        (pair, tuple(UnitResult(unit, points[key]) for unit, key in pair.points.items()))
        for pair in job.pairs
    ]
