"""The check of answers, once, where they arrive: an answer of another shape is a loss of its worker.

A worker with its own fault (memory that flips bits, another version of a library) may answer
anything. The loop, the store and the submission trust each answer that has passed this check.
"""

import json
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any

import numpy as np

from mkpc_kaggle.engine.jobs import (
    Answer,
    Estimated,
    EstimateJob,
    Failure,
    FeatureJob,
    Found,
    Job,
    Loaded,
    MatchJob,
    Outcome,
    PairInputs,
    SceneJob,
)
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import (
    MAX_THIRD,
    MAX_THIRD_OF_E,
    Estimate,
    EstimateStats,
    is_fundamental,
)
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

MAX_COUNT = 1 << 40  # of matches, keypoints or bytes; the state has 64-bit numbers


class WrongAnswerError(Exception):
    """A part of an answer that no worker of this version gives."""


def wrong_answer(job: Job | None, answer: Answer) -> str:
    """Return what is wrong with the answer to a job, or an empty string.

    Without a job, the worker was starting.
    """
    if isinstance(answer, Failure):
        return ""
    try:
        match job:
            case None:
                _require(isinstance(answer, Loaded), answer, "the start of a worker")
            case MatchJob():
                _check_outcomes(job, answer)
            case EstimateJob():
                _check_estimates(job, answer)
            case SceneJob():
                _check_solution(job, answer)
            case FeatureJob():
                _check_features(answer)
    # Attributes of an object of another version may be missing, and arrays may be anything.
    except Exception as error:
        return (
            str(error)
            if isinstance(error, WrongAnswerError)
            else f"{type(error).__name__}: {error}"
        )
    return ""


def _require(is_right: bool, value: Any, what: str) -> None:
    if not is_right:
        # The value may have megabytes.
        raise WrongAnswerError(f"{what}: {str(value)[:80]!r}")


def _check_tuple(values: Any, kind: Any, count: int | None, what: str) -> None:
    """Require a tuple of ``count`` values of a kind."""
    is_tuple = isinstance(values, tuple) and all(isinstance(each, kind) for each in values)
    _require(is_tuple, type(values).__name__, f"not a tuple of {what}")
    _require(count is None or len(values) == count, len(values), f"not {count} {what}")


def _check_counts(values: Iterable[Any], what: str) -> None:
    """Require Python's own integers, as JSON has no others."""
    for value in values:
        is_count = isinstance(value, int) and 0 <= value <= MAX_COUNT
        _require(is_count, value, f"no number of {what}")


def _check_seconds(values: Iterable[Any]) -> None:
    for value in values:
        is_time = isinstance(value, int | float) and isfinite(value) and value >= 0
        _require(is_time, value, "no number of seconds")


def _check_numbers(array: Any, shape: tuple[int | None, ...], what: str) -> None:
    """Require finite real numbers; ``None`` in a shape is any length."""
    is_array = isinstance(array, np.ndarray) and array.ndim == len(shape)
    _require(is_array, array, f"no array of {what}")
    lengths = zip(array.shape, shape, strict=True)
    has_shape = all(wanted is None or length == wanted for length, wanted in lengths)
    _require(has_shape and array.dtype.kind == "f", (array.shape, array.dtype), f"shape of {what}")
    _require(bool(np.isfinite(array).all()), what, "numbers that are not finite")


def _check_text(*values: Any) -> None:
    for value in values:
        _require(isinstance(value, str), value, "no text")


# Matching


def _check_outcomes(job: MatchJob, answer: Any) -> None:
    _check_tuple(answer, Outcome, len(job.indices), "results of pairs")
    for names, outcome in zip(job.names, answer, strict=True):
        _check_text(outcome.failure)
        _check_tuple(outcome.results, UnitResult, None, "results of units")
        # An unreadable image is a result without images.
        if outcome.failure:
            _require(not outcome.results, outcome.failure, "points of an unreadable image")
        else:
            _check_images(names, outcome)
        units = [found.unit for found in outcome.results]
        is_asked = len(set(units)) == len(units) and set(units) <= set(job.units)
        _require(is_asked, [unit.name for unit in units], "units that were not asked for")
        for found in outcome.results:
            _check_unit(found)
        if outcome.regions is not None:
            _check_tuple(outcome.regions, CriticalRegion, 2, "critical regions")
        _check_seconds([outcome.decode_seconds, outcome.cluster_seconds])


def _check_images(names: Sequence[str], outcome: Outcome) -> None:
    _check_tuple(outcome.images, BatchImage, 2, "images")
    for image, name in zip(outcome.images, names, strict=True):
        _require(image.name == name, image.name, f"another image than {name}")
        _check_text(image.digest)
        _require(bool(image.digest), name, "no digest of an image")
        _require(isinstance(image.size, Size), image.size, "no size of an image")
        _check_counts(image.size, "pixels")
        _check_seconds([image.focal])  # a finite number, and not negative
    _require(len(outcome.files) == 2, outcome.files, "not two files")
    for file in outcome.files:
        _check_tuple(file, int, 2, "numbers of a file")


def _check_unit(found: UnitResult) -> None:
    matches = found.matches
    _require(isinstance(matches, Matches), matches, "no matches")
    count = len(matches)
    _check_numbers(matches.points0, (count, 2), "points")
    _check_numbers(matches.points1, (count, 2), "points")
    _check_numbers(matches.scores, (count,), "scores")
    _check_counts([found.keypoints], "keypoints")
    _check_seconds([found.encode_seconds, found.match_seconds])
    _check_text(found.failure, found.note)


# Estimates


def _check_estimates(job: EstimateJob, answer: Any) -> None:
    _check_tuple(answer, Estimated, len(job.pairs), "estimates")
    for pair, found in zip(job.pairs, answer, strict=True):
        _check_estimate(pair, found)


def _check_estimate(pair: PairInputs, found: Estimated) -> None:
    keys = tuple(pair.points.values())
    _require(found.points == keys, found.points, "an estimate from other points")
    _check_tuple(found.inliers, int, len(keys), "numbers of inliers")
    _check_counts(found.inliers, "inliers")
    # With known intrinsics, it is an E.
    max_third = MAX_THIRD if pair.intrinsics is None else MAX_THIRD_OF_E
    is_model = is_fundamental(found.F, max_third)
    _require(is_model, found.F, "F is not a finite matrix of rank 2")
    if found.magsac is not None:
        _check_numbers(found.magsac, (3, 3), "MAGSAC's F")
    _check_text(found.failure)
    _check_seconds([found.seconds])
    _check_stats(found.stats)


def _check_stats(stats: Any) -> None:
    _require(isinstance(stats, EstimateStats), stats, "no statistics")
    _check_counts([stats.candidates], "candidates")
    numbers = [stats.cost, stats.magsac_cost, *stats.focals, stats.support, *stats.rotation]
    for value in numbers:
        _require(isfinite(value), value, "no finite statistics")


# Scenes and features


def _check_solution(job: SceneJob, answer: Any) -> None:
    _require(isinstance(answer, Solution), answer, "no reconstruction")
    _check_tuple(answer.choices, Choice, len(job.pairs), "choices")
    for choice in answer.choices:
        if choice.F is not None:
            _require(is_fundamental(choice.F), choice.F, "F is not a finite matrix of rank 2")
    estimates = answer.estimates
    _check_tuple(estimates, Estimate | None, len(job.pairs) * job.with_estimates, "estimates")
    for found in estimates:
        if found is not None:
            _require(is_fundamental(found.matrix), found.matrix, "F is not a matrix of rank 2")
            _check_stats(found.stats)
    _check_tuple(answer.reconstructions, Reconstruction, None, "reconstructions")
    for found in answer.reconstructions:
        _check_tuple(found.names, str, None, "names")
        _check_tuple(found.models, SfmModel, None, "models")
        for model in found.models:
            _check_model(model)


def _check_model(model: SfmModel) -> None:
    _check_numbers(model.points, (None, 3), "points")
    _check_seconds([model.reprojection_error])  # a finite number, and not negative
    _check_tuple(model.images, RegisteredImage, None, "cameras")
    for found in model.images:
        camera = found.camera
        _check_numbers(camera.K, (3, 3), "K")
        _check_numbers(camera.R, (3, 3), "R")
        _check_numbers(camera.t, (3,), "t")
        _check_counts([found.points], "points")


def _check_features(answer: Any) -> None:
    _require(isinstance(answer, Found), answer, "features")
    # Other values are stored as JSON, which has no NaN.
    if not isinstance(answer.value, bytes):
        json.dumps(answer.value, allow_nan=False)
