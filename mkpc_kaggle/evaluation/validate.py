"""Runs the engine on a train side and scores it as the competition does."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite, nan
from pathlib import Path
from statistics import mean
from typing import Any

from mkpc_kaggle.data.competition import TrainScene, TruePair, pair_id, read_rows, read_submission
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry import metrics
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS, PoseError
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.pipeline.assembly import Assembly

MAX_NAMES = 5  # of samples, in a line


class Step(StrEnum):
    """The estimates of a pair's F, in the order in which they are made."""

    MAGSAC = "MAGSAC"
    PRIOR = "+ prior"  # on the focal lengths
    SCENE = "+ scene"  # with the cameras of the pair's batch, if these give an F


@dataclass(frozen=True)
class PairScore:
    """One pair's error, infinite for a failed pair, and its record if the engine made it.

    ``steps`` are the errors after each :class:`Step` that was made; the last is ``error``.
    """

    id: str
    images: tuple[str, str]
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
    def images(self) -> list[tuple[str, str]]:
        return [pair.images for pair in self.pairs]

    def accuracies(self, step: Step | None = None) -> list[float]:
        """The accuracy of each pair after a step, by default the last."""
        return [metrics.pair_accuracy(pair.steps[step] if step else pair.error) for pair in self.pairs]

    def maa(self, step: Step | None = None) -> float:
        """The mean of :meth:`accuracies`: the mAA of the Image Matching Challenge 2022."""
        return mean(self.accuracies(step)) if self.in_metres else nan

    def auc(self, threshold: float) -> float:
        return metrics.pose_auc(self.errors, threshold)


@dataclass(frozen=True)
class Validation:
    """The scores of all scenes under one recipe.

    A submission that is scored from its file has no ``report`` and no ``steps``; ``missing`` are the samples that
    it has no row for.
    """

    recipe: str
    scenes: tuple[SceneScore, ...]
    report: RunReport | None = None
    steps: tuple[Step, ...] = ()
    missing: tuple[str, ...] = ()

    def maa(self, step: Step | None = None) -> float:
        """The mean of the scenes' mAA after a step, by default the last: the competition's figure."""
        return mean(scene.maa(step) for scene in self.scenes)

    def auc(self, threshold: float) -> float:
        return mean(scene.auc(threshold) for scene in self.scenes)

    @property
    def errors(self) -> list[PoseError]:
        return [error for scene in self.scenes for error in scene.errors]


def validate(scenes: Sequence[TrainScene], assembly: Assembly, session: Session, root: str = "") -> Validation:
    """Run the recipe on the pairs of all scenes, whose images lie below ``root``, and score it."""
    report = run_pairs([true.pair for scene in scenes for true in scene.pairs], assembly, session, root=root)
    prior = assembly.recipe.focal is not None
    made = {  # if E is sought at known focal lengths, there is no MAGSAC alone
        Step.MAGSAC: not prior or any(record.magsac_fundamental is not None for record in report.records),
        Step.PRIOR: prior,
        Step.SCENE: any(record.scene is not None for record in report.records),
    }
    steps = tuple(step for step in Step if made[step])
    records, scored = iter(report.records), []
    for scene in scenes:
        pairs = tuple(score_record(true, next(records), scene, steps) for true in scene.pairs)
        scored.append(SceneScore(scene.name, pairs, isfinite(scene.metres_per_unit)))
    return Validation(assembly.recipe.name, tuple(scored), report, steps)


def score_record(true: TruePair, record: PairRecord, scene: TrainScene, steps: Sequence[Step] = ()) -> PairScore:
    """The score of a pair's record; the fallback row counts as a failure."""
    own = None if record.failure else record.pair_fundamental
    matrices = {
        Step.MAGSAC: record.magsac_fundamental if Step.PRIOR in steps else own,
        Step.PRIOR: own,
        Step.SCENE: None if record.source == "fallback" else record.chosen_fundamental,
    }
    errors = {step: error_of(matrix, true, scene) for step, matrix in matrices.items()}
    made = {step: errors[step] for step in steps}
    return PairScore(true.pair.id, true.pair.names, true.covisibility, errors[Step.SCENE], record, made)


def error_of(matrix: Matrix3 | None, true: TruePair, scene: TrainScene) -> PoseError:
    """The error of a pair's F, or of its E if that is what was estimated; infinite if there is none."""
    if matrix is None:
        return PoseError.failed()
    camera0, camera1 = true.camera0, true.camera1
    if true.pair.model is ModelKind.E:
        camera0, camera1 = camera0.calibrated, camera1.calibrated
    return metrics.pose_error(matrix, camera0, camera1, scene.metres_per_unit)


def score_submission(submission: Path, truth: Path, scenes: Sequence[TrainScene]) -> Validation:
    """Score a submission whose samples are known pairs of a train side.

    ``truth`` is a table ``sample_id,scene,image_1_id,image_2_id``, the images named as in the train side.
    Samples that the table or the scenes lack are left out; those that the submission lacks count as failed.
    Raises :class:`UserError` for files that cannot be read.
    """
    found = read_submission(submission)
    columns = ("sample_id", "scene", "image_1_id", "image_2_id")
    # The sample and its F by the id that the pair has in the train side, in either order.
    known: dict[str, tuple[str, Matrix3 | None]] = {}
    for _, (sample, scene, first, second) in read_rows(truth, columns):
        F = found.get(sample)
        known[pair_id(scene, first, second)] = sample, F
        known[pair_id(scene, second, first)] = sample, None if F is None else F.T
    scored, missing = [], []
    for there in scenes:
        of_scene = [(true, *known[true.pair.id]) for true in there.pairs if true.pair.id in known]
        missing += [sample for _, sample, F in of_scene if F is None]
        pairs = tuple(
            PairScore(true.pair.id, true.pair.names, true.covisibility, error_of(F, true, there))
            for true, _, F in of_scene
        )
        scored += [SceneScore(there.name, pairs)] if pairs else []
    if len(missing) == sum(len(scene.pairs) for scene in scored):
        raise UserError(f"{truth} names no pair of the scenes that {submission} has a row for")
    return Validation(submission.name, tuple(scored), missing=tuple(missing))


def score_table(validation: Validation) -> list[str]:
    """Lines: a row for each scene and their mean; a dash for the mAA of unknown metres.

    The columns are the mAA, after each step if there are several, and the pose AUC after the last.
    """
    several = len(validation.steps) > 1
    heads = [*(validation.steps if several else ["mAA"]), *(f"AUC {angle:.0f}" for angle in AUC_THRESHOLDS)]
    lines = [f"{'scene':<20}{'pairs':>6}" + "".join(f"{head:>9}" for head in heads)]
    rows: list[tuple[str, SceneScore | Validation]] = [(scene.scene, scene) for scene in validation.scenes]
    for name, scores in [*rows, ("mean over scenes", validation)]:
        accuracies = map(scores.maa, validation.steps or [None])
        values = (*accuracies, *map(scores.auc, AUC_THRESHOLDS))
        cells = (f"{value:>9.4f}" if isfinite(value) else f"{'-':>9}" for value in values)
        lines.append(f"{name:<20}{len(scores.errors):>6}" + "".join(cells))
    return ["mAA after each step, AUC after the last:", *lines] if several else lines


def missing_rows(validation: Validation) -> list[str]:
    """A line that names the samples without a row, if there are any."""
    missing = validation.missing
    if not missing:
        return []
    more = f" and {len(missing) - MAX_NAMES} more" if len(missing) > MAX_NAMES else ""
    return [f"{len(missing)} samples have no row and count as failed: {', '.join(missing[:MAX_NAMES])}{more}"]


def to_json(validation: Validation) -> dict[str, Any]:
    """All figures of a validation as JSON values: overall, per scene, per pair; what is not finite is null."""
    steps, report = validation.steps, validation.report
    records = report.records if report else ()
    reasons = Counter(str(region.reason) for record in records for region in record.regions or ())
    return {
        "recipe": validation.recipe,
        "missing": validation.missing,
        **_scores_json(validation, steps),
        "seconds": report and report.seconds,
        "seconds_per_pair": report and report.seconds / len(records),
        "matches_by_stage": _stage_means(records, "matches"),
        "inliers_by_stage": _stage_means(records, "inliers"),
        "region_reasons": dict(reasons),
        "scenes": [
            {"scene": scene.scene, **_scores_json(scene, steps), "pairs": [*map(_pair_json, scene.pairs)]}
            for scene in validation.scenes
        ],
    }


def _scores_json(scores: SceneScore | Validation, steps: Sequence[Step]) -> dict[str, Any]:
    return {
        "mAA": _finite(scores.maa()),
        "mAA_by_step": {step: _finite(scores.maa(step)) for step in steps},
        "AUC": {f"{threshold:g}": scores.auc(threshold) for threshold in AUC_THRESHOLDS},
    }


def _stage_means(records: Sequence[PairRecord], what: str) -> dict[str, float]:
    """Mean number of matches or inliers on a pair, by stage."""
    sums = Counter[int]()
    for unit in (unit for record in records for unit in record.units):
        sums[unit.stage] += getattr(unit, what)
    return {str(stage): sums[stage] / len(records) for stage in sorted(sums)}


def _pair_json(pair: PairScore) -> dict[str, Any]:
    values: dict[str, Any] = {
        "pair": pair.id,
        "covisibility": _finite(pair.covisibility),
        "rotation_error_degrees": _finite(pair.error.rotation),
        "translation_error_metres": _finite(pair.error.translation),
        "translation_error_degrees": _finite(pair.error.translation_angle),
        "accuracy_by_step": {step: metrics.pair_accuracy(error) for step, error in pair.steps.items()},
    }
    if (record := pair.record) is not None:
        values |= {"failure": record.failure, "inliers": record.inliers}
        values["matches"] = {unit.unit: unit.matches for unit in record.units}
        values["regions"] = [str(region.reason) for region in record.regions or ()]
    return values


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
