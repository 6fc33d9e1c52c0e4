"""The work of workers: matching, estimates, reconstructions.

Importing this module does not import torch, which estimates and scenes do not need.
The threads of each worker are decided in :mod:`mkpc_kaggle.cores`.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from mkpc_kaggle.cores import limit_matching_threads, limit_to_one_thread
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, ImageStore
from mkpc_kaggle.engine.request import (
    Answer,
    Cause,
    Estimated,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    MatchJob,
    PairInputs,
    SceneJob,
)
from mkpc_kaggle.errors import UserError, shown
from mkpc_kaggle.matchers import failures
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.candidates import (
    ALL_UNITS,
    candidate_settings,
    candidate_tracks,
    disagreement,
)
from mkpc_kaggle.scene.models import models_of
from mkpc_kaggle.scene.sfm import Solution, reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchPair

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
    """A runner of match jobs with ``threads`` threads, or as one of ``share`` processes that share
    the cores. One that is not ``is_limited`` leaves PyTorch's and OpenCV's threads as they are.

    ``refused`` has the reason for each matcher that cannot be loaded: the run continues without its units. Raises
    :class:`mkpc_kaggle.errors.UserError` if none can be loaded.
    """

    def __init__(
        self,
        make_pipeline: Callable[[], "Pipeline"],
        *,
        threads: int = 0,
        share: int = 1,
        is_limited: bool = True,
    ) -> None:
        if is_limited:
            limit_matching_threads(threads, share)
        self._pipeline = make_pipeline()
        self._pipeline.load()
        self.refused = self._pipeline.unloadable
        self._images = ImageStore()

    def __call__(self, job: Job) -> tuple[PairMatch, ...]:
        """Match the pairs of a job with each unit that is expected to end in time."""
        assert isinstance(job, MatchJob)
        # Durations and not moments in the job: other machines have other clocks.
        deadline = time.monotonic() + job.seconds
        expected = dict(zip(job.units, job.expected, strict=True))

        def may_start(unit: Unit, pairs: int) -> bool:
            return time.monotonic() + pairs * expected[unit] < deadline

        given = job.given or [()] * len(job.pairs)
        opened = list(map(self._open, job.pairs, job.digests, given))
        # Decoding the next pairs' images takes place while a GPU matches.
        self._images.prefetch(job.upcoming)
        # An unreadable image fails its pair alone, not the minibatch.
        readable = [pair for pair in opened if not pair.failure]
        matched = iter(self._pipeline.match(readable, job.units, may_start))
        done = [pair if pair.failure else next(matched) for pair in opened]
        # Without the given points, and without pixels
        return tuple(
            replace(pair, results=pair.results[len(before) :], images=())
            for pair, before in zip(done, given, strict=True)
        )

    def _open(
        self, pair: Pair, digests: tuple[str, ...], given: tuple[UnitResult, ...]
    ) -> PairMatch:
        """Return a pair with its images; ``failure`` names an image that is unreadable, or has changed."""
        images = []
        failure = ""
        for path, turns, digest in zip(pair.images, pair.turns, digests, strict=True):
            image = self._images.get(path).turned(turns)
            if not isinstance(image, Image):
                failure = failure or str(image)
            # Otherwise wrong points would have a right key for ever.
            elif image.version != digest:
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
    """Return the estimates of a job's pairs."""
    assert isinstance(job, EstimateJob)
    return tuple(estimate_pair(pair, results, job.recipe) for pair, results in with_points(job))


def estimate_pair(pair: PairInputs, results: tuple[UnitResult, ...], recipe: Recipe) -> Estimated:
    """Estimate F of a pair from its points of all units."""
    start = time.perf_counter()
    # From the digested contents, so the images are not decoded again.
    sizes = tuple(image.size for image in pair.images)
    focals = tuple(image.focal for image in pair.images)
    match = PairMatch(results, sizes=sizes, focals=focals)
    found = with_estimate(match, recipe).estimate
    # The inliers of each unit, by the bounds of its matches among all
    counts = [len(result.matches) for result in results]
    masks = np.split(found.inliers, np.cumsum(counts)[:-1])
    inliers = tuple(int(mask.sum()) for mask in masks)
    return Estimated(
        tuple(pair.points.values()),
        inliers,
        found.matrix,
        found.failure,
        found.magsac,
        found.stats,
        time.perf_counter() - start,
    )


def scene_runner() -> Runner:
    """Return the runner of a process that does one job: a scene."""
    return compute_scene


def compute_scene(job: Job) -> Solution:
    """Return the reconstructions of a batch, and a choice for each pair. pycolmap may end the
    process.
    """
    assert isinstance(job, SceneJob) and job.recipe.scene is not None
    inputs = with_points(job)
    is_whole = job.folder is not None
    pairs = [batch_pair(*pair, keeps_paths=is_whole, candidate=job.candidate) for pair in inputs]
    recipe = job.recipe
    solution = reconstruct_batch(
        pairs,
        candidate_settings(job.candidate, job.recipe.scene),
        recipe.focal,
        recipe.magsac,
        job.folder,
        cameras=job.cameras,
    )
    value = disagreement(pairs, models_of(solution.reconstructions))
    return replace(solution, disagreement=value)


def batch_pair(
    pair: PairInputs,
    results: tuple[UnitResult, ...],
    *,
    keeps_paths: bool,
    candidate: str = ALL_UNITS,
) -> BatchPair:
    """Return a pair of a batch with its points, and the tracks of a candidate.

    Images have their file names. With ``keeps_paths`` they have their paths below the root, as in
    COLMAP's files, in tables of intrinsics and in the cameras of an earlier run.
    """
    image0, image1 = (
        image if keeps_paths else replace(image, name=Path(image.name).name)
        for image in pair.images
    )
    by_unit = tuple(result.matches for result in results)
    return BatchPair(image0, image1, by_unit, pair.own, candidate_tracks(results, candidate))


def with_points(
    job: EstimateJob | SceneJob,
) -> list[tuple[PairInputs, tuple[UnitResult, ...]]]:
    """Return each pair of a job with the points of its units."""
    keys = [key for pair in job.pairs for key in pair.points.values()]
    points = job.source.matches(keys)
    return [
        (pair, tuple(UnitResult(unit, points[key]) for unit, key in pair.points.items()))
        for pair in job.pairs
    ]
