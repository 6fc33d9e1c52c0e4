"""Runs of the engine on pairs with known cameras, their scores, and differences of scores."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mkpc_kaggle.data.competition import (
    TrainScene,
    TruePair,
    read_rows,
    read_submission,
)
from mkpc_kaggle.engine.frames import ELEMENTS, Results
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry import metrics
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS, PoseError
from mkpc_kaggle.setup.assembly import Assembly

if TYPE_CHECKING:
    from pandas import DataFrame

MAX_NAMES = 5  # of samples to list in a line
LEVEL = 0.95  # of confidence intervals
RESAMPLES = 10_000  # another seed moves the interval's ends by about a hundredth of its width

# Values of the same pairs under two recipes, and the two images of each pair.
Paired: TypeAlias = tuple[Sequence[float], Sequence[float], Sequence[tuple[str, str]]]


class Step(StrEnum):
    """Successive estimates of a pair's F."""

    MAGSAC = "MAGSAC"
    PRIOR = "+ prior"  # the prior on the focal lengths
    SCENE = "+ scene"  # the F of the batch's reconstructed cameras, if they give one


@dataclass(frozen=True)
class PairScore:
    """The errors of a pair's F after each step of the run, infinite if the pair failed.

    A submission scored from its file has no steps. ``error`` is the last one.
    """

    id: str
    images: tuple[str, str]  # paths: lists may have one file name in several folders
    covisibility: float
    error: PoseError
    steps: Mapping[Step, PoseError]


@dataclass(frozen=True)
class SceneScore:
    """The scores of one scene's pairs."""

    scene: str
    pairs: tuple[PairScore, ...]

    @property
    def errors(self) -> list[PoseError]:
        return [pair.error for pair in self.pairs]

    def accuracies(self, step: Step | None = None) -> list[float]:
        """Return the accuracy of each pair after a step, by default the last."""
        errors = [pair.steps[step] if step else pair.error for pair in self.pairs]
        return [metrics.pair_accuracy(error) for error in errors]

    def maa(self, step: Step | None = None) -> float:
        """Return the mean of :meth:`accuracies`: the mAA of the Image Matching Challenge 2022."""
        return mean(self.accuracies(step))

    def auc(self, threshold: float) -> float:
        """Return the pose AUC up to ``threshold`` degrees."""
        return metrics.pose_auc(self.errors, threshold)


@dataclass(frozen=True)
class Validation:
    """The scores of all scenes under one recipe.

    A submission scored from its file has no ``report`` and no ``steps``; ``missing`` lists samples
    without a row.
    """

    recipe: str
    scenes: tuple[SceneScore, ...]
    report: Results | None = None
    steps: tuple[Step, ...] = ()
    missing: tuple[str, ...] = ()

    def maa(self, step: Step | None = None) -> float:
        """Return the competition's figure: the mean of the scenes' mAA after a step, by default the
        last.
        """
        return mean(scene.maa(step) for scene in self.scenes)

    def auc(self, threshold: float) -> float:
        """Return the mean of the scenes' pose AUC up to ``threshold`` degrees."""
        return mean(scene.auc(threshold) for scene in self.scenes)

    @property
    def errors(self) -> list[PoseError]:
        return [error for scene in self.scenes for error in scene.errors]


def validate(
    scenes: Sequence[TrainScene], assembly: Assembly, session: Session, root: str = ""
) -> Validation:
    """Run the recipe on the pairs of all scenes, whose images lie below ``root``; score the results."""
    pairs = [true.pair for scene in scenes for true in scene.pairs]
    report = run_pairs(pairs, assembly, session, root=root)
    steps = [Step.MAGSAC]
    if assembly.recipe.focal is not None:
        steps.append(Step.PRIOR)
    if (report.pairs["choice"] != "").any():
        steps.append(Step.SCENE)
    rows = itertools.count()  # in the order of the pairs
    scored = []
    for scene in scenes:
        scores = [
            score_pair(true, report.pairs, next(rows), scene, steps) for true in scene.pairs
        ]
        scored.append(SceneScore(scene.name, tuple(scores)))
    return Validation(assembly.recipe.name, tuple(scored), report, tuple(steps))


def score_pair(
    true: TruePair,
    pairs: "DataFrame",
    row: int,
    scene: TrainScene,
    steps: Sequence[Step] = (),
) -> PairScore:
    """Return the score of the pair in a row of the run's table of pairs.

    An F from the fallback counts as a failure.
    """
    pair = pairs.loc[row]
    own = None if pair["failure"] else pair["own"]
    # Without a prior, the pair's F is MAGSAC's.
    matrices = {Step.MAGSAC: pair["magsac"] if Step.PRIOR in steps else own, Step.PRIOR: own}
    # The row of the submission: the scene's F, else the pair's.
    written = pair[ELEMENTS].to_numpy(float).reshape(3, 3)
    matrices[Step.SCENE] = None if pair["source"] == "fallback" else written
    # The last step's error is the pair's, also where a step was not made.
    errors = {step: error_of(matrix, true, scene) for step, matrix in matrices.items()}
    return scored_pair(true, errors[Step.SCENE], {step: errors[step] for step in steps})


def scored_pair(
    true: TruePair, error: PoseError, steps: Mapping[Step, PoseError] | None = None
) -> PairScore:
    images = (true.pair.file0, true.pair.file1)
    return PairScore(true.pair.id, images, true.covisibility, error, steps or {})


def error_of(matrix: ArrayLike | None, true: TruePair, scene: TrainScene) -> PoseError:
    """Return the error of a pair's F; infinite without one."""
    if matrix is None:
        return PoseError.failed()
    F = np.reshape(matrix, (3, 3))
    return metrics.pose_error(F, true.camera0, true.camera1, scene.metres_per_unit)


def score_submission(
    submission: Path, truth: Path, scenes: Sequence[TrainScene]
) -> Validation:
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
        known = [true for true in there.pairs if true.pair.id in samples]
        missing += [
            sample for sample, F in (samples[true.pair.id] for true in known) if F is None
        ]
        pairs = [
            scored_pair(true, error_of(samples[true.pair.id][1], true, there))
            for true in known
        ]
        if pairs:
            scored.append(SceneScore(there.name, tuple(pairs)))
    if len(missing) == sum(len(scene.pairs) for scene in scored):
        raise UserError(
            f"{truth} names no pair of the scenes that {submission} has a row for"
        )
    return Validation(submission.name, tuple(scored), missing=tuple(missing))


@dataclass(frozen=True)
class Difference:
    """The gain of the second of two recipes over the first, with its interval at :data:`LEVEL`."""

    gain: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.gain:+z.4f} [{self.low:+z.4f}, {self.high:+z.4f}]"


def paired_difference(scenes: Sequence[Paired]) -> Difference:
    """Return the gain with its confidence interval.

    The gain is averaged over each scene's pairs and then over scenes. Pairs that share an image are
    not independent. So the bootstrap resamples images, not pairs: each image of a scene gets a
    random weight, and the product of two image weights is a pair's weight. Scenes are not
    resampled. The same input gives the same interval. If pairs share no image, the interval is up
    to 1.7 times too wide. Sources: Rubin 1981 (exponential weights); Owen 2007 (products of
    weights).
    """
    generator = np.random.default_rng(0)  # a fixed seed: the same input, the same interval
    means: list[float] = []
    resampled: list[NDArray[np.float64]] = []
    for first, second, images in scenes:
        gains = np.asarray(second, np.float64) - np.asarray(first, np.float64)
        means.append(float(gains.mean()))
        resampled.append(_resampled_means(gains, images, generator))
    # Scenes count equally, as in the mAA, with few pairs or many.
    overall = np.mean(resampled, axis=0)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(overall, [tail, 1 - tail])
    return Difference(mean(means), float(low), float(high))


def _resampled_means(
    gains: NDArray[np.float64],
    images: Sequence[tuple[str, str]],
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Return weighted means (RESAMPLES,) of the gains (P,), one for each draw of image weights."""
    names, ends = np.unique(np.array(images), return_inverse=True)
    first, second = ends.reshape(-1, 2).T  # (P,): the indices of each pair's images
    # Two tables by image and image, so that one product gives all resamples.
    gain_sums = np.zeros((len(names), len(names)))
    pair_counts = np.zeros((len(names), len(names)))
    # Not by indexing: a pair of images may be in the list twice, in two turns.
    np.add.at(gain_sums, (first, second), gains)
    np.add.at(pair_counts, (first, second), 1.0)
    weights = generator.exponential(size=(RESAMPLES, len(names)))
    # Row by row the quadratic form w^T A w: the sum of w_i w_j a_ij over all pairs.
    total = (weights @ gain_sums * weights).sum(axis=1)
    count = (weights @ pair_counts * weights).sum(axis=1)
    return np.asarray(total / count)


def gain_of(other: Validation, first: Validation, scene: str | None = None) -> Difference:
    """Return the gain in mAA of ``other`` over ``first`` on the same pairs, of one scene or the mean
    over scenes.
    """
    paired: list[Paired] = []
    # Both have the same scenes and pairs, in the same order.
    for before, after in zip(first.scenes, other.scenes, strict=True):
        if scene in (None, before.scene):
            images = [pair.images for pair in before.pairs]
            paired.append((before.accuracies(), after.accuracies(), images))
    return paired_difference(paired)


def score_frame(validation: Validation) -> "DataFrame":
    """Return the scores as a table: a row for each scene and one for their mean.

    The columns are the scene, its number of pairs, the mAA after each step, and the pose AUC after
    the last step.
    """
    from pandas import DataFrame  # the import takes most of a second

    # A single step needs no name: the column is the mAA.
    steps = validation.steps if len(validation.steps) > 1 else ["mAA"]
    heads = [*map(str, steps), *(f"AUC {angle:.0f}" for angle in AUC_THRESHOLDS)]
    rows = []
    named: list[tuple[str, SceneScore | Validation]] = [
        (scene.scene, scene) for scene in validation.scenes
    ]
    for name, scores in [*named, ("mean over scenes", validation)]:
        accuracies = map(scores.maa, validation.steps or [None])
        rows.append((name, len(scores.errors), *accuracies, *map(scores.auc, AUC_THRESHOLDS)))
    return DataFrame(rows, columns=["scene", "pairs", *heads])


def score_table(validation: Validation) -> list[str]:
    """Return the lines of :func:`score_frame`, and a line with the samples without a row, if any."""
    table = score_frame(validation).set_index("scene").rename_axis(None)
    lines = table.to_string(float_format="{:.4f}".format).splitlines()
    if missing := validation.missing:
        more = f" and {len(missing) - MAX_NAMES} more" if len(missing) > MAX_NAMES else ""
        names = ", ".join(missing[:MAX_NAMES]) + more
        count = plural(len(missing), "sample")
        lines.append(f"{count} without a row, counted as failed: {names}")
    return lines


def comparison_table(validations: Sequence[Validation]) -> list[str]:
    """Return lines: each recipe's mAA, then its gain over the first, by scene and overall."""
    first, *others = validations
    lines = [f"{'recipe':<40}{'mAA':>9}"]
    lines += [f"{run.recipe:<40}{run.maa():>9.4f}" for run in validations]
    for other in others:
        lines.append(
            f"{other.recipe} against {first.recipe}: gain of mAA, {LEVEL:.0%} interval"
        )
        for scene in first.scenes:
            count = len(scene.pairs)
            lines.append(f"{scene.scene:<20}{count:>6}  {gain_of(other, first, scene.scene)}")
        lines.append(
            f"{'mean over scenes':<20}{len(first.errors):>6}  {gain_of(other, first)}"
        )
    return lines


def to_json(validation: Validation) -> dict[str, Any]:
    """Return the scores as JSON values: overall, by scene and by pair. Infinite errors are null."""
    scenes = []
    for scene in validation.scenes:
        pairs = []
        for pair in scene.pairs:
            error = pair.error
            values = {
                "rotation_error_degrees": error.rotation,
                "translation_error_metres": error.translation,
                "translation_error_degrees": error.translation_angle,
            }
            finite = {
                name: value if isfinite(value) else None for name, value in values.items()
            }
            steps = {step: metrics.pair_accuracy(found) for step, found in pair.steps.items()}
            pairs.append(
                {
                    "pair": pair.id,
                    "images": pair.images,
                    "covisibility": pair.covisibility,
                    **finite,
                    "accuracy_by_step": steps,
                }
            )
        scenes.append({"scene": scene.scene, "mAA": scene.maa(), "pairs": pairs})
    return {
        "recipe": validation.recipe,
        "mAA": validation.maa(),
        "mAA_by_step": {step: validation.maa(step) for step in validation.steps},
        "AUC": {f"{threshold:g}": validation.auc(threshold) for threshold in AUC_THRESHOLDS},
        "missing": validation.missing,
        "scenes": scenes,
    }
