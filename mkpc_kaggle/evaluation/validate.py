"""Runs the engine on a train side and scores it as the competition does."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from mkpc_kaggle.data.competition import Scene, TruePair, pair_id, read_submission, read_table
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.metrics import (
    AUC_THRESHOLDS,
    PoseError,
    mean_average_accuracy,
    pose_auc,
    pose_error,
)
from mkpc_kaggle.geometry.robust import Matrix3, Model
from mkpc_kaggle.pipeline.assembly import Assembly


@dataclass(frozen=True)
class PairScore:
    """One pair's error, infinite for a failed pair, and its record where the engine made one."""

    id: str
    covisibility: float
    error: PoseError
    record: PairRecord | None = None


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

    def auc(self, threshold: float) -> float:
        return pose_auc(self.errors, threshold)


@dataclass(frozen=True)
class Validation:
    """The scores of all scenes under one recipe; ``report`` is ``None`` for a submission scored from its file."""

    recipe: str
    scenes: tuple[SceneScore, ...]
    report: RunReport | None = None

    @property
    def maa(self) -> float:
        """The mean of the scenes' mAA: the competition's figure."""
        return mean(scene.maa for scene in self.scenes)

    def auc(self, threshold: float) -> float:
        return mean(scene.auc(threshold) for scene in self.scenes)

    @property
    def errors(self) -> list[PoseError]:
        """Those of all pairs."""
        return [error for scene in self.scenes for error in scene.errors]

    @property
    def records(self) -> list[PairRecord]:
        return [pair.record for scene in self.scenes for pair in scene.pairs if pair.record is not None]


def validate(scenes: Sequence[Scene], assembly: Assembly, session: Session) -> tuple[Validation, bool]:
    """Match all pairs of the scenes and score them; also whether every thread has stopped."""
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    report, at_rest = run_pairs(pairs, assembly, session)
    records = iter(report.records)
    scored = tuple(
        SceneScore(
            scene.name,
            tuple(score_record(true, next(records), scene) for true in scene.pairs),
            isfinite(scene.metres_per_unit),
        )
        for scene in scenes
    )
    return Validation(assembly.recipe.name, scored, report), at_rest


def own_scores(validation: Validation, scenes: Sequence[Scene]) -> Validation:
    """The same run, each pair scored by the F of its own matches: what its scene's cameras are compared with."""
    scored = tuple(
        SceneScore(
            score.scene,
            tuple(
                PairScore(pair.id, pair.covisibility, _own_error(pair, true, scene), pair.record)
                for pair, true in zip(score.pairs, scene.pairs, strict=True)
            ),
            score.in_metres,
        )
        for score, scene in zip(validation.scenes, scenes, strict=True)
    )
    return Validation(validation.recipe, scored, validation.report)


def _own_error(pair: PairScore, true: TruePair, scene: Scene) -> PoseError:
    if pair.record is None or pair.record.failure:
        return PoseError.failed()
    return error_of(pair.record.F, true, scene)


def score_record(true: TruePair, record: PairRecord, scene: Scene) -> PairScore:
    """The score of a pair's record; the fallback row counts as a failure."""
    error = PoseError.failed() if record.source == "fallback" else error_of(record.fundamental, true, scene)
    return PairScore(true.pair.id, true.covisibility, error, record)


def error_of(matrix: Matrix3, true: TruePair, scene: Scene) -> PoseError:
    """The error of a pair's F, or of its E if that is what was estimated."""
    cameras = true.camera0, true.camera1
    if true.pair.model is Model.E:
        cameras = true.camera0.calibrated, true.camera1.calibrated
    return pose_error(matrix, *cameras, scene.metres_per_unit)


def score_submission(submission: Path, truth: Path, scenes: Sequence[Scene]) -> Validation:
    """Score a submission whose samples are known pairs of a train side.

    ``truth`` is a table ``sample_id,scene,image_1_id,image_2_id``, the images named as in the train side.
    Samples that the table or the scenes lack are left out; raises
    :class:`mkpc_kaggle.errors.UserError` for files that cannot be read.
    """
    found = read_submission(submission)
    columns = ("sample_id", "scene", "image_1_id", "image_2_id")
    known: dict[str, Matrix3] = {}  # F by the id that the pair has in the train side, in either order
    for sample, scene, first, second in read_table(truth, columns)[list(columns)].itertuples(index=False):
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
    """Lines: a row a scene and their mean, with mAA and pose AUC; a dash for the mAA of unknown metres."""
    heads = [f"AUC {threshold:.0f}" for threshold in AUC_THRESHOLDS]
    lines = [f"{'scene':<20}{'pairs':>6}{'mAA':>9}" + "".join(f"{head:>9}" for head in heads)]
    for scene in validation.scenes:
        aucs = "".join(f"{scene.auc(threshold):>9.4f}" for threshold in AUC_THRESHOLDS)
        lines.append(f"{scene.scene:<20}{len(scene.pairs):>6}{_cell(scene.maa)}{aucs}")
    aucs = "".join(f"{validation.auc(threshold):>9.4f}" for threshold in AUC_THRESHOLDS)
    count = sum(len(scene.pairs) for scene in validation.scenes)
    return [*lines, f"{'mean over scenes':<20}{count:>6}{_cell(validation.maa)}{aucs}"]


def _cell(value: float) -> str:
    return f"{value:>9.4f}" if isfinite(value) else f"{'-':>9}"


def to_json(validation: Validation) -> dict[str, Any]:
    """All figures of a validation as JSON values: overall, per scene, per pair; what is not finite is null."""
    records = validation.records
    reasons = Counter(str(region.reason) for record in records for region in record.regions or ())
    return {
        "recipe": validation.recipe,
        "mAA": _finite(validation.maa),
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
