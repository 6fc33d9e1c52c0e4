"""Runs of the engine on pairs with known cameras, and their scores.

A train side is scored by the competition's rules, a list of pairs by the rules of SuperGlue and
LoFTR.
"""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import isfinite, nan
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from scipy.spatial.transform import Rotation

from mkpc_kaggle.data.competition import (
    TrainScene,
    TruePair,
    evenly_spread,
    read_rows,
    read_submission,
)
from mkpc_kaggle.data.images import read_size
from mkpc_kaggle.engine.request import RunReport
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import PairTables, by_pair, matrices_of
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry import metrics
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS, PoseError
from mkpc_kaggle.geometry.resolution import doubt_about_resolution
from mkpc_kaggle.geometry.robust import Method, RobustConfig
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.setup.assembly import Assembly

if TYPE_CHECKING:
    from pandas import DataFrame

MAX_SIZES = 100  # of images that are read and compared with their calibrations
MAX_NAMES = 5  # of samples to list in a line
BOX = ["left", "top", "right", "bottom"]  # columns of the table of regions
MATCHING = ("precision", "matching_score")  # the order of ``PairScore.matching``

# OpenCV's RANSAC as in both published evaluations: 1 pixel, and 0.5 pixels for LoFTR.
SUPERGLUE = RobustConfig(Method.RANSAC, 1.0, max_iterations=1000, permutations=1, every_match=True)
PROTOCOLS = {"superglue": SUPERGLUE, "loftr": replace(SUPERGLUE, threshold=0.5)}


def resolution_line(scenes: Sequence[TrainScene]) -> str:
    """Return a line on images whose calibration seems to be for another resolution; empty without any.

    Their true F, and so their scores, would be wrong.
    """
    matrices: dict[str, Matrix3] = {}
    for true in itertools.chain.from_iterable(scene.pairs for scene in scenes):
        matrices.setdefault(true.pair.file0, true.camera0.K)
        matrices.setdefault(true.pair.file1, true.camera1.K)
    doubts = []
    sample = evenly_spread(list(matrices), MAX_SIZES)
    for file in sample:
        size = read_size(Path(file))  # a missing image has a line of its own
        doubt = "" if size is None else doubt_about_resolution(matrices[file], size)
        if doubt:
            doubts.append(f"{file}: {doubt}")
    if not doubts:
        return ""
    return (
        f"{len(doubts)} of {plural(len(sample), 'calibration')} may be for images of another resolution, "
        f"and then the scores are wrong; the first is {doubts[0]}"
    )


class Step(StrEnum):
    """Successive estimates of a pair's F."""

    MAGSAC = "MAGSAC"
    PRIOR = "+ prior"  # the prior on the focal lengths
    SCENE = "+ scene"  # the F of the batch's reconstructed cameras, if they give one


@dataclass(frozen=True)
class PairScore:
    """One pair's error, infinite if the pair failed, and its row in the run's tables if the engine ran.

    ``steps`` has the error after each :class:`Step` of the run; the last equals ``error``.
    ``matching``, for pairs of a list, is correct matches over all matches (precision) and over
    keypoints of image 0 (matching score).
    """

    id: str
    images: tuple[str, str]
    covisibility: float
    error: PoseError
    row: int | None = None
    steps: Mapping[Step, PoseError] = field(default_factory=dict)
    matching: tuple[float, float] = (nan, nan)


@dataclass(frozen=True)
class SceneScore:
    """The scores of one scene's pairs; the mAA is NaN if the scene's scale in metres is unknown."""

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
        """Return the accuracy of each pair after a step, by default the last."""
        errors = [pair.steps[step] if step else pair.error for pair in self.pairs]
        return [metrics.pair_accuracy(error) for error in errors]

    def maa(self, step: Step | None = None) -> float:
        """Return the mean of :meth:`accuracies`: the mAA of the Image Matching Challenge 2022."""
        # Without metres, no translation error meets a threshold: 0 would be misleading.
        return mean(self.accuracies(step)) if self.in_metres else nan

    def auc(self, threshold: float) -> float:
        """Return the pose AUC up to ``threshold`` degrees."""
        return metrics.pose_auc(self.errors, threshold)

    @property
    def matching(self) -> list[float]:
        """The mean precision and the mean matching score of the pairs."""
        return _column_means([pair.matching for pair in self.pairs])


@dataclass(frozen=True)
class Validation:
    """The scores of all scenes under one recipe.

    A submission scored from its file has no ``report`` and no ``steps``; ``missing`` lists samples
    without a row.
    """

    recipe: str
    scenes: tuple[SceneScore, ...]
    report: RunReport | None = None
    steps: tuple[Step, ...] = ()
    missing: tuple[str, ...] = ()

    def maa(self, step: Step | None = None) -> float:
        """Return the competition's figure: the mean of the scenes' mAA after a step.

        By default after the last step.
        """
        return mean(scene.maa(step) for scene in self.scenes)

    def auc(self, threshold: float) -> float:
        """Return the mean of the scenes' pose AUC up to ``threshold`` degrees."""
        return mean(scene.auc(threshold) for scene in self.scenes)

    @property
    def matching(self) -> list[float]:
        """The means over scenes of precision and matching score."""
        return _column_means([scene.matching for scene in self.scenes])

    @property
    def errors(self) -> list[PoseError]:
        return [error for scene in self.scenes for error in scene.errors]


def _column_means(rows: Sequence[Sequence[float]]) -> list[float]:
    return [mean(column) for column in zip(*rows, strict=True)]


def by_protocol(recipe: Recipe, protocol: str) -> Recipe:
    """Return the recipe with the settings of a protocol.

    Scoring by a protocol also sets ``in_front`` of :func:`validate`. SuperGlue's threshold is in
    pixels of the resized image, whose long side is the largest of stage 1.
    """
    # Both published evaluations resize by OpenCV's bilinear filter, without antialiasing.
    units = tuple(replace(unit, antialias=False) for unit in recipe.units)
    magsac = PROTOCOLS[protocol]
    if protocol == "superglue":
        sides = []
        for unit in units:
            if unit.stage == 1:
                sides.append(unit.long_side or max(map(int, unit.area.split("x"))))
        magsac = replace(magsac, threshold_side=max(sides))
    # A published evaluation estimates each pair by itself, and has no prior.
    return replace(recipe, units=units, magsac=magsac, focal=None, scene=None)


def validate(
    scenes: Sequence[TrainScene],
    assembly: Assembly,
    session: Session,
    root: str = "",
    *,
    in_front: bool = False,
) -> Validation:
    """Run the recipe on the pairs of all scenes, and score the results.

    Images lie below ``root``. With ``in_front``, the inliers of an E select one of its two
    rotations.
    """
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    report = run_pairs(pairs, assembly, session, root=root)
    steps = _steps(report, has_prior=assembly.recipe.focal is not None)
    rows = itertools.count()  # in the order of the pairs
    scored = []
    for scene in scenes:
        scores = [
            score_pair(true, report.tables, next(rows), scene, steps, in_front)
            for true in scene.pairs
        ]
        in_metres = isfinite(scene.metres_per_unit)
        # A list of pairs: its evaluations publish precision and matching score, too.
        if not in_metres:
            with Store.read(session.work_dir) as store:
                scores = list(_with_matching(scores, scene.pairs, store, report.tables))
        scored.append(SceneScore(scene.name, tuple(scores), in_metres))
    return Validation(assembly.recipe.name, tuple(scored), report, steps)


def _steps(report: RunReport, *, has_prior: bool) -> tuple[Step, ...]:
    """Return the steps that a run made."""
    steps = []
    # With known focal lengths, E has no step before the prior.
    if not has_prior or report.tables.estimates["magsac"].notna().any():
        steps.append(Step.MAGSAC)
    if has_prior:
        steps.append(Step.PRIOR)
    if (report.tables.pairs["choice"] != "").any():
        steps.append(Step.SCENE)
    return tuple(steps)


def _with_matching(
    scores: Sequence[PairScore], pairs: Sequence[TruePair], store: Store, tables: PairTables
) -> Iterator[PairScore]:
    """Yield the scores with ``matching`` set, by the points in the store."""
    published = Published.of(store)
    rows = published.rows
    units = by_pair(tables.units)
    for score, true in zip(scores, pairs, strict=True):
        assert score.row is not None
        points = published.points_of(store, rows[score.row])
        matches = Matches.concatenate(points.values())
        yield replace(score, matching=matching_of(true, matches, units.get(score.id)))


def matching_of(true: TruePair, matches: Matches, units: "DataFrame | None") -> tuple[float, float]:
    """Return the precision of a pair's matches, and their matching score.

    ``units`` are the pair's rows in the table of units, if any. The matching score is NaN if
    numbers of keypoints are unknown.
    """
    # All matches, not only inliers, as in SuperGlue's evaluation.
    correct = metrics.correct_matches(matches, true.camera0, true.camera1).sum()
    # Dense matchers have matches and no keypoints.
    is_known = units is None or ((units["keypoints"] > 0) | (units["matches"] == 0)).all()
    keypoints = 0 if units is None else int(units["keypoints"].sum())
    precision = correct / max(len(matches), 1)
    score = correct / max(keypoints, 1) if is_known else nan
    return precision, score


def score_pair(
    true: TruePair,
    tables: PairTables,
    row: int,
    scene: TrainScene,
    steps: Sequence[Step] = (),
    in_front: bool = False,
) -> PairScore:
    """Return the score of the pair in a row of the run's tables. An F from the fallback counts as a
    failure. The F of an earlier run, perhaps with other settings, does not count.
    """
    pair = tables.pairs.loc[row]
    estimate = tables.estimates.loc[row]
    rotation = Rotation.from_rotvec(estimate["rotation"]).as_matrix() if in_front else None
    own: Any = None if pair["failure"] else estimate["F"]
    magsac: Any = estimate["magsac"]
    matrices: dict[Step, Matrix3 | None] = {
        # Without a prior, the pair's F is MAGSAC's.
        Step.MAGSAC: magsac if Step.PRIOR in steps else own,
        Step.PRIOR: own,
        Step.SCENE: own,
    }
    if pair["source"] != "earlier":
        # The row of the submission: the scene's F, else the pair's.
        written = matrices_of(tables.pairs.loc[[row]])[0]
        matrices[Step.SCENE] = None if pair["source"] == "fallback" else written
    # The last step's error is the pair's, also where a step was not made.
    errors = {step: error_of(matrix, true, scene, rotation) for step, matrix in matrices.items()}
    made = {step: errors[step] for step in steps}
    return PairScore(
        true.pair.id, image_paths_of(true), true.covisibility, errors[Step.SCENE], row, made
    )


def image_paths_of(true: TruePair) -> tuple[str, str]:
    """Return the paths of a pair's images: lists may have one file name in several folders."""
    return true.pair.file0, true.pair.file1


def error_of(
    matrix: Matrix3 | None, true: TruePair, scene: TrainScene, rotation: Matrix3 | None = None
) -> PoseError:
    """Return the error of a pair's F, or of its E with a given rotation; infinite without one."""
    if matrix is None:
        return PoseError.failed()
    camera0 = true.camera0
    camera1 = true.camera1
    if true.pair.intrinsics is not None:
        # The matrix is an E, the F of calibrated cameras.
        camera0 = camera0.calibrated
        camera1 = camera1.calibrated
    return metrics.pose_error(matrix, camera0, camera1, scene.metres_per_unit, rotation)


def score_submission(submission: Path, truth: Path, scenes: Sequence[TrainScene]) -> Validation:
    """Score a submission whose samples are known pairs of a train side.

    ``truth`` is a table ``sample_id,scene,image_1_id,image_2_id``, with the image names of the
    train side. Samples missing from the table or the scenes are left out; samples missing from the
    submission count as failed. Raises :class:`UserError` for unreadable files.
    """
    matrices = read_submission(submission)
    columns = ("sample_id", "scene", "image_1_id", "image_2_id")
    # By the pair's id in the train side, with its images in either order: the sample and its F.
    samples: dict[str, tuple[str, Matrix3 | None]] = {}
    for _, (sample, scene, first, second) in read_rows(truth, columns):
        F = matrices.get(sample)
        samples[f"{scene};{first}-{second}"] = (sample, F)
        # x2^T F x1 = x1^T F^T x2.
        samples[f"{scene};{second}-{first}"] = (sample, None if F is None else F.T)
    scored = []
    missing = []
    for there in scenes:
        pairs = []
        for true in there.pairs:
            if true.pair.id not in samples:
                continue
            sample, F = samples[true.pair.id]
            if F is None:
                missing.append(sample)
            error = error_of(F, true, there)
            pairs.append(PairScore(true.pair.id, image_paths_of(true), true.covisibility, error))
        if pairs:
            scored.append(SceneScore(there.name, tuple(pairs)))
    if len(missing) == sum(len(scene.pairs) for scene in scored):
        raise UserError(f"{truth} names no pair of the scenes that {submission} has a row for")
    return Validation(submission.name, tuple(scored), missing=tuple(missing))


def score_table(validation: Validation) -> list[str]:
    """Return a row for each scene and a row of their mean, with a dash for unknown figures.

    The columns are the mAA after each step, and the pose AUC after the last step. Lists of pairs
    also have precision and matching score. The last line names samples without a row, if any.
    """
    table = score_frame(validation)
    figures = table.drop(columns=["scene", "pairs"])
    lines = [f"{'scene':<20}{'pairs':>6}" + "".join(f"{head:>9}" for head in figures)]
    rows = zip(table["scene"], table["pairs"], figures.to_numpy(), strict=True)
    for name, count, values in rows:
        cells = (f"{value:>9.4f}" if isfinite(value) else f"{'-':>9}" for value in values)
        lines.append(f"{name:<20}{count:>6}" + "".join(cells))
    if missing := validation.missing:
        more = f" and {len(missing) - MAX_NAMES} more" if len(missing) > MAX_NAMES else ""
        names = ", ".join(missing[:MAX_NAMES]) + more
        count = plural(len(missing), "sample")
        lines.append(f"{count} without a row, counted as failed: {names}")
    several = len(validation.steps) > 1
    return ["mAA after each step, AUC after the last:", *lines] if several else lines


def score_frame(validation: Validation) -> "DataFrame":
    """Return the scores as a table: a row for each scene and one for their mean.

    The columns are the scene, its number of pairs, and the figures of :func:`score_table`; unknown
    figures are NaN.
    """
    from pandas import DataFrame  # the import takes most of a second

    is_list = not all(scene.in_metres for scene in validation.scenes)
    # A single step needs no name: the column is the mAA.
    steps = validation.steps if len(validation.steps) > 1 else ["mAA"]
    heads = [*map(str, steps), *(f"AUC {angle:.0f}" for angle in AUC_THRESHOLDS)]
    heads += ["precis.", "m.score"] if is_list else []
    named: list[tuple[str, SceneScore | Validation]] = [
        (scene.scene, scene) for scene in validation.scenes
    ]
    rows = []
    for name, scores in [*named, ("mean over scenes", validation)]:
        accuracies = map(scores.maa, validation.steps or [None])
        areas = map(scores.auc, AUC_THRESHOLDS)
        matching = scores.matching if is_list else ()
        rows.append((name, len(scores.errors), *accuracies, *areas, *matching))
    return DataFrame(rows, columns=["scene", "pairs", *heads])


def to_json(validation: Validation) -> dict[str, Any]:
    """Return all figures as JSON values: overall, per scene and per pair.

    Numbers that are not finite are null.
    """
    steps = validation.steps
    report = validation.report
    scenes = []
    run = {} if report is None else _runs_json(report.tables)
    for scene in validation.scenes:
        # A submission from a file has no run.
        pairs = [
            _pair_json(pair, in_metres=scene.in_metres) | run.get(pair.id, {})
            for pair in scene.pairs
        ]
        scenes.append({"scene": scene.scene, **_scores_json(scene, steps), "pairs": pairs})
    figures = {
        "recipe": validation.recipe,
        "missing": validation.missing,
        **_scores_json(validation, steps),
        "seconds": report and report.seconds,
        "scenes": scenes,
    }
    # Python writes NaN and Infinity, which JSON does not have.
    values: dict[str, Any] = json.loads(json.dumps(figures), parse_constant=lambda _: None)
    return values


def _scores_json(scores: SceneScore | Validation, steps: Sequence[Step]) -> dict[str, Any]:
    return {
        "mAA": scores.maa(),
        "mAA_by_step": {step: scores.maa(step) for step in steps},
        "AUC": {f"{threshold:g}": scores.auc(threshold) for threshold in AUC_THRESHOLDS},
        **dict(zip(MATCHING, scores.matching, strict=True)),
    }


def _pair_json(pair: PairScore, *, in_metres: bool) -> dict[str, Any]:
    return {
        "pair": pair.id,
        "covisibility": pair.covisibility,
        "rotation_error_degrees": pair.error.rotation,
        "translation_error_metres": pair.error.translation,
        "translation_error_degrees": pair.error.translation_angle,
        **dict(zip(MATCHING, pair.matching, strict=True)),
        "accuracy_by_step": {
            # Without metres, no translation error meets a threshold: 0 would be misleading.
            step: metrics.pair_accuracy(error) if in_metres else None
            for step, error in pair.steps.items()
        },
    }


def _runs_json(tables: PairTables) -> dict[str, dict[str, Any]]:
    """Return the facts of a run about each pair, by id."""
    units = by_pair(tables.units)
    regions = by_pair(tables.regions)
    facts = {}
    columns = ["pair", "failure", "inliers"]
    for pair, failure, inliers in zip(*(tables.pairs[name] for name in columns), strict=True):
        ran = units.get(pair)
        cropped = regions.get(pair)
        facts[pair] = {
            "failure": failure,
            "inliers": inliers,
            "matches": {} if ran is None else dict(zip(ran["unit"], ran["matches"], strict=True)),
            "regions": [] if cropped is None else cropped["reason"].tolist(),
            # In pixels of the image
            "boxes": [] if cropped is None else cropped[BOX].to_numpy().tolist(),
        }
    return facts
