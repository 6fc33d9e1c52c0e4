"""Runs the engine on a train side and scores it as the competition does."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite, nan
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from mkpc_kaggle.data.competition import TrainScene, TruePair, pair_id, read_rows, read_submission
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.metrics import (
    AUC_THRESHOLDS,
    PoseError,
    mean_average_accuracy,
    pair_accuracy,
    pose_auc,
    pose_error,
)
from mkpc_kaggle.geometry.robust import Matrix3, ModelKind
from mkpc_kaggle.pipeline.assembly import Assembly


class Step(StrEnum):
    """The estimates of a pair's F, in the order in which they are made."""

    MAGSAC = "MAGSAC"
    PRIOR = "+ prior"
    """with the prior on the focal lengths"""
    SCENE = "+ scene"
    """with the cameras of its batch, where these give an F"""


@dataclass(frozen=True)
class PairScore:
    """One pair's error, infinite for a failed pair, and its record where the engine made one.

    ``steps`` are the errors after each :class:`Step` that was made; the last is ``error``.
    """

    id: str
    covisibility: float
    error: PoseError
    record: PairRecord | None = None
    steps: Mapping[Step, PoseError] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneScore:
    """The scores of one scene's pairs; without metres there is no mAA."""

    scene: str
    pairs: tuple[PairScore, ...]
    in_metres: bool = True

    @property
    def errors(self) -> list[PoseError]:
        return [pair.error for pair in self.pairs]

    @property
    def maa(self) -> float:
        return mean_average_accuracy(self.errors) if self.in_metres else nan

    def maa_after(self, step: Step) -> float:
        return mean_average_accuracy([pair.steps[step] for pair in self.pairs]) if self.in_metres else nan

    def auc(self, threshold: float) -> float:
        return pose_auc(self.errors, threshold)


@dataclass(frozen=True)
class Validation:
    """The scores of all scenes under one recipe.

    A submission that is scored from its file has no ``report`` and no ``steps``.
    """

    recipe: str
    scenes: tuple[SceneScore, ...]
    report: RunReport | None = None
    steps: tuple[Step, ...] = ()

    @property
    def maa(self) -> float:
        """The mean of the scenes' mAA: the competition's figure."""
        return mean(scene.maa for scene in self.scenes)

    def maa_after(self, step: Step) -> float:
        return mean(scene.maa_after(step) for scene in self.scenes)

    def auc(self, threshold: float) -> float:
        return mean(scene.auc(threshold) for scene in self.scenes)

    @property
    def errors(self) -> list[PoseError]:
        """Those of all pairs."""
        return [error for scene in self.scenes for error in scene.errors]

    @property
    def records(self) -> list[PairRecord]:
        return [pair.record for scene in self.scenes for pair in scene.pairs if pair.record is not None]


def validate(scenes: Sequence[TrainScene], assembly: Assembly, session: Session) -> tuple[Validation, bool]:
    """Match all pairs of the scenes and score them; also whether every thread has stopped."""
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    report, at_rest = run_pairs(pairs, assembly, session)
    steps = steps_of(report.records, prior=assembly.recipe.focal is not None)
    records = iter(report.records)
    scored = tuple(
        SceneScore(
            scene.name,
            tuple(score_record(true, next(records), scene, steps) for true in scene.pairs),
            isfinite(scene.metres_per_unit),
        )
        for scene in scenes
    )
    return Validation(assembly.recipe.name, scored, report, steps), at_rest


def steps_of(records: Sequence[PairRecord], *, prior: bool) -> tuple[Step, ...]:
    """The steps that a run made; where E is sought at known focal lengths, there is no MAGSAC alone."""
    steps = [Step.MAGSAC] if not prior or any(one.magsac is not None for one in records) else []
    steps += [Step.PRIOR] if prior else []
    return (*steps, Step.SCENE) if any(one.scene is not None for one in records) else tuple(steps)


def score_record(true: TruePair, record: PairRecord, scene: TrainScene, steps: Sequence[Step] = ()) -> PairScore:
    """The score of a pair's record; the fallback row counts as a failure."""
    own = None if record.failure else record.F
    found = {
        Step.MAGSAC: record.magsac if Step.PRIOR in steps else own,
        Step.PRIOR: own,
        Step.SCENE: None if record.source == "fallback" else record.fundamental,
    }
    error = error_of(found[Step.SCENE], true, scene)
    errors = {step: error_of(found[step], true, scene) for step in steps}
    return PairScore(true.pair.id, true.covisibility, error, record, errors)


def error_of(matrix: Matrix3 | None, true: TruePair, scene: TrainScene) -> PoseError:
    """The error of a pair's F, or of its E if that is what was estimated; infinite where there is none."""
    if matrix is None:
        return PoseError.failed()
    cameras = true.camera0, true.camera1
    if true.pair.model is ModelKind.E:
        cameras = true.camera0.calibrated, true.camera1.calibrated
    return pose_error(matrix, *cameras, scene.metres_per_unit)


def score_submission(submission: Path, truth: Path, scenes: Sequence[TrainScene]) -> Validation:
    """Score a submission whose samples are known pairs of a train side.

    ``truth`` is a table ``sample_id,scene,image_1_id,image_2_id``, the images named as in the train side.
    Samples that the table or the scenes lack are left out; raises
    :class:`mkpc_kaggle.errors.UserError` for files that cannot be read.
    """
    found = read_submission(submission)
    columns = ("sample_id", "scene", "image_1_id", "image_2_id")
    known: dict[str, Matrix3] = {}  # F by the id that the pair has in the train side, in either order
    for _, (sample, scene, first, second) in read_rows(truth, columns):
        if sample in found:
            known[pair_id(scene, first, second)] = found[sample]
            known[pair_id(scene, second, first)] = found[sample].T
    scores = [
        SceneScore(
            scene.name,
            tuple(
                PairScore(true.pair.id, true.covisibility, error_of(known[true.pair.id], true, scene))
                for true in scene.pairs
                if true.pair.id in known
            ),
        )
        for scene in scenes
    ]
    scored = tuple(scene for scene in scores if scene.pairs)
    if not scored:
        raise UserError(f"{truth} names no pair of the scenes that {submission} has a row for")
    return Validation(submission.name, scored)


def score_table(validation: Validation) -> list[str]:
    """Lines: a row a scene and their mean; a dash for the mAA of unknown metres.

    The columns are the mAA, after each step where there are several, and the pose AUC after the last.
    """
    several = len(validation.steps) > 1
    heads = [
        *(validation.steps if several else ["mAA"]),
        *(f"AUC {threshold:.0f}" for threshold in AUC_THRESHOLDS),
    ]
    lines = [f"{'scene':<20}{'pairs':>6}" + "".join(f"{head:>9}" for head in heads)]
    rows: list[tuple[str, int, SceneScore | Validation]] = [
        (one.scene, len(one.pairs), one) for one in validation.scenes
    ]
    rows.append(("mean over scenes", sum(count for _, count, _ in rows), validation))
    for name, count, scores in rows:
        accuracies = map(scores.maa_after, validation.steps) if several else [scores.maa]
        values = [*accuracies, *map(scores.auc, AUC_THRESHOLDS)]
        lines.append(f"{name:<20}{count:>6}" + "".join(map(_cell, values)))
    return ["mAA after each step, AUC after the last:", *lines] if several else lines


def _cell(value: float) -> str:
    return f"{value:>9.4f}" if isfinite(value) else f"{'-':>9}"


def to_json(validation: Validation) -> dict[str, Any]:
    """All figures of a validation as JSON values: overall, per scene, per pair; what is not finite is null."""
    records = validation.records
    reasons = Counter(str(region.reason) for record in records for region in record.regions or ())
    return {
        "recipe": validation.recipe,
        "mAA": _finite(validation.maa),
        "mAA_by_step": {step: _finite(validation.maa_after(step)) for step in validation.steps},
        "AUC": {f"{threshold:g}": validation.auc(threshold) for threshold in AUC_THRESHOLDS},
        "seconds": validation.report.seconds if validation.report else None,
        "seconds_per_pair": validation.report.seconds / len(records) if validation.report else None,
        "matches_by_stage": stage_means(records, "matches"),
        "inliers_by_stage": stage_means(records, "inliers"),
        "region_reasons": dict(reasons),
        "scenes": [
            {
                "scene": scene.scene,
                "mAA": _finite(scene.maa),
                "mAA_by_step": {step: _finite(scene.maa_after(step)) for step in validation.steps},
                "AUC": {f"{threshold:g}": scene.auc(threshold) for threshold in AUC_THRESHOLDS},
                "pairs": [_pair_json(pair) for pair in scene.pairs],
            }
            for scene in validation.scenes
        ],
    }


def stage_means(records: Sequence[PairRecord], what: str) -> Mapping[str, float]:
    """Mean number of matches or inliers on a pair, by stage."""
    return {
        str(stage): float(
            np.mean([sum(getattr(unit, what) for unit in r.units if unit.stage == stage) for r in records])
        )
        for stage in sorted({unit.stage for record in records for unit in record.units})
    }


def _pair_json(pair: PairScore) -> dict[str, Any]:
    error, record = pair.error, pair.record
    values: dict[str, Any] = {
        "pair": pair.id,
        "covisibility": _finite(pair.covisibility),
        "rotation_error_degrees": _finite(error.rotation),
        "translation_error_metres": _finite(error.translation),
        "translation_error_degrees": _finite(error.translation_angle),
        "accuracy_by_step": {step: pair_accuracy(error) for step, error in pair.steps.items()},
    }
    if record is not None:
        values |= {
            "failure": record.failure,
            "inliers": record.inliers,
            "matches": {unit.unit: unit.matches for unit in record.units},
            "regions": [str(region.reason) for region in record.regions or ()],
        }
    return values


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
