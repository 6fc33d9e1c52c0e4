"""The score of the Image Matching Challenge 2025: clusters of mixed images, and their cameras.

``train_labels.csv`` has ``dataset,scene,image,rotation_matrix,translation_vector``,
``train_thresholds.csv`` has ``dataset,scene,thresholds``. Numbers in a cell are joined by ``;``.
Poses map world to camera. An image of ``outliers`` belongs to no scene.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import POSITIVE, decimal
from mkpc_kaggle.data.competition import read_rows
from mkpc_kaggle.errors import UserError, plural, shown

OUTLIERS = "outliers"
POSE_COLUMNS = ("dataset", "scene", "image", "rotation_matrix", "translation_vector")
SKIPPED_THRESHOLDS = 2  # the finest thresholds, below the accuracy of the ground truth
FREE = 3  # images that do not count, because some similarity always fits them
MAX_TRIPLETS = 20_000  # per scene and cluster; a random sample of this size if there are more
REFINEMENTS = 10
MIN_SPREAD = 1e-12  # sum of squared distances from the mean; centres with a smaller sum coincide
MAX_NUMBER = 1e12  # in a cell; keeps squares of derived numbers finite

WorldPoints = NDArray[np.float64]  # (N, 3)
# Camera centre (3,) by image, in a scene or cluster; NaN without a camera.
Centres = Mapping[str, WorldPoints]
Parts = Mapping[str, Centres]  # the scenes or the clusters of a dataset, by name


@dataclass(frozen=True)
class DatasetScore:
    """The score of a dataset.

    ``maa`` is pooled over scenes. ``clusterness`` is the share of correct images in the scenes'
    clusters.
    """

    dataset: str
    maa: float
    clusterness: float

    @property
    def score(self) -> float:
        """Harmonic mean of both figures."""
        total = self.maa + self.clusterness
        return 2 * self.maa * self.clusterness / total if total else 0.0


def score_imc2025(directory: Path, submission: Path) -> list[DatasetScore]:
    """Return the submission's score for each dataset of the train side in ``directory``.

    Raises :class:`UserError` for unreadable files, for numbers that cannot be scored, and for a
    missing, unknown or repeated image or dataset.
    """
    labels = directory / "train_labels.csv"
    path = directory / "train_thresholds.csv"
    truth = _centres(labels)
    found = _centres(submission)
    thresholds = _thresholds(path)
    for name, scenes in truth.items():
        _require_poses(labels, name, scenes)
        if wrong := _images(scenes) ^ _images(found.get(name, {})):
            count = plural(len(wrong), "image")
            message = f"{count} of {name} missing or unknown, such as {min(wrong)}"
            raise UserError(f"{submission}: {shown(message)}")
        for scene in scenes:
            if scene != OUTLIERS and scene not in thresholds.get(name, {}):
                raise UserError(f"{path} has no thresholds of {shown(f'{name}/{scene}')}")
    for file, named in ((submission, found), (path, thresholds)):
        if unknown := named.keys() - truth.keys():
            raise UserError(f"{file}: {labels} lacks the dataset {min(unknown)!r}")
    scores = []
    for name, scenes in truth.items():
        # A dataset of outliers only needs no thresholds.
        scores.append(score_dataset(name, scenes, found[name], thresholds.get(name, {})))
    return scores


def _images(parts: Parts) -> set[str]:
    """Return the images of all scenes or clusters."""
    return {image for part in parts.values() for image in part}


def _require_poses(labels: Path, name: str, scenes: Parts) -> None:
    """Raise :class:`UserError` for an image of a scene without a pose."""
    for scene, centres in scenes.items():
        for image, centre in centres.items():
            if scene != OUTLIERS and not np.isfinite(centre).all():
                raise UserError(
                    f"{labels}: {shown(f'{name}/{image}')} has no pose, "
                    f"and is not of the scene {OUTLIERS}"
                )


def score_dataset(
    name: str,
    scenes: Parts,
    clusters: Parts,
    thresholds: Mapping[str, Sequence[float] | WorldPoints],
) -> DatasetScore:
    """Return the score of a dataset.

    Each scene takes the cluster with most of its images; mAA decides ties. The mAA's numerators and
    denominators are summed over the scenes before the division.
    """
    accurate = possible = common = taken = 0
    for scene in scenes.keys() - {OUTLIERS}:
        centres = scenes[scene]
        limits = thresholds[scene][SKIPPED_THRESHOLDS:]
        # Of each cluster: common images, accurate images, all images.
        choices = []
        for label, cluster in clusters.items():
            shared = centres.keys() & cluster.keys()
            if label != OUTLIERS and shared:
                count = accurate_images(centres, cluster, limits)
                choices.append((len(shared), count, len(cluster)))
        overlap, count, size = max(choices, key=lambda each: each[:2], default=(0, 0, 0))
        accurate += count
        possible += len(limits) * max(len(centres) - FREE, 0)
        common += overlap
        taken += size
    maa = accurate / possible if possible else 0.0
    clusterness = common / taken if taken else 0.0
    return DatasetScore(name, maa, clusterness)


def accurate_images(
    truth: Centres, cluster: Centres, thresholds: Sequence[float] | WorldPoints
) -> int:
    """Return the number of accurate images beyond ``FREE``, summed over thresholds.

    For each threshold, the best similarity of three images is refitted to its inliers. Inliers are
    images whose transformed cluster centre is within the threshold of the scene's.
    """
    shared = truth.keys() & cluster.keys()
    # In a fixed order, as the triplets may be a random sample.
    common = sorted(name for name in shared if np.isfinite(cluster[name]).all())
    if len(common) < FREE:
        return 0
    source = np.array([cluster[name] for name in common])
    target = np.array([truth[name] for name in common])
    tried = residuals(source, target, _triplets(len(common)))  # (B, N)
    total = 0
    for threshold in thresholds:
        most = (tried < threshold).sum(axis=1).argmax()
        near = tried[most] < threshold
        # At least the three images that any similarity fits.
        best = FREE
        for _ in range(REFINEMENTS):
            best = max(best, int(near.sum()))
            if near.sum() < FREE:
                break
            near = residuals(source, target, near.nonzero()[0][None])[0] < threshold
        total += best - FREE
    return total


def residuals(
    source: WorldPoints, target: WorldPoints, fitted: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Fit a similarity to each row of indices ``fitted`` (B, k); return the distances (B, N).

    Distances are from ``target``, of all transformed sources; they are NaN if the fitted sources
    coincide. Source: Umeyama 1991, the solution of Horn's problem by a singular value
    decomposition.
    """
    x = source[fitted]  # (B, k, 3)
    y = target[fitted]
    x_mean = x.mean(axis=1, keepdims=True)
    y_mean = y.mean(axis=1, keepdims=True)
    covariance = np.swapaxes(y - y_mean, 1, 2) @ (x - x_mean)  # (B, 3, 3)
    U, S, Vt = np.linalg.svd(covariance)
    # A reflection becomes a rotation by the sign of the smallest singular value.
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    S[:, 2] *= sign
    spread = ((x - x_mean) ** 2).sum(axis=(1, 2))
    scale = S.sum(axis=1) / np.where(spread < MIN_SPREAD, np.nan, spread)
    R = U @ Vt  # (B, 3, 3)
    scaled = scale[:, None, None] * (source - x_mean)  # (B, N, 3)
    moved = scaled @ np.swapaxes(R, 1, 2) + y_mean
    return np.asarray(np.linalg.norm(moved - target, axis=2))


def _triplets(count: int) -> NDArray[np.intp]:
    """Return triplets (B, 3) of ``count`` images: all, or a random sample of them."""
    if count * (count - 1) * (count - 2) // 6 <= MAX_TRIPLETS:
        return np.array(list(combinations(range(count), 3)), np.intp)
    drawn = np.random.default_rng(0).random((MAX_TRIPLETS, count))
    return np.argpartition(drawn, 3, axis=1)[:, :3]


def _thresholds(path: Path) -> dict[str, dict[str, WorldPoints]]:
    """Return the thresholds by dataset and scene."""
    found: dict[str, dict[str, WorldPoints]] = {}
    for where, (dataset, scene, cell) in read_rows(path, ("dataset", "scene", "thresholds")):
        limits = _numbers(cell, where)
        if len(limits) <= SKIPPED_THRESHOLDS or not all(limit in POSITIVE for limit in limits):
            raise UserError(
                f"{where}: expected {SKIPPED_THRESHOLDS + 1} positive thresholds or more, found {cell!r}"
            )
        if scene in found.setdefault(dataset, {}):
            raise UserError(f"{where}: the scene {shown(f'{dataset}/{scene}')} is there twice")
        found[dataset][scene] = limits
    return found


def _centres(path: Path) -> dict[str, dict[str, dict[str, WorldPoints]]]:
    """Return the camera centres of a table of poses: by dataset, by scene or cluster, by image."""
    found: dict[str, dict[str, dict[str, WorldPoints]]] = {}
    seen: set[tuple[str, str]] = set()
    for where, (dataset, scene, image, *cells) in read_rows(path, POSE_COLUMNS):
        if (dataset, image) in seen:
            raise UserError(f"{where}: the image {shown(f'{dataset}/{image}')} is there twice")
        seen.add((dataset, image))
        # An image of an outlier or without a camera has NaN in every number.
        R, t = (_numbers(cell, where) for cell in cells)
        if (len(R), len(t)) != (9, 3):
            raise UserError(
                f"{where}: expected 9 and 3 numbers joined by ';', found {len(R)} and {len(t)}"
            )
        scenes = found.setdefault(dataset, {})
        scenes.setdefault(scene, {})[image] = -R.reshape(3, 3).T @ t  # the camera's centre
    if not found:
        raise UserError(f"{path} has no rows to score")
    return found


def _numbers(cell: str, where: str) -> WorldPoints:
    """Return the numbers of a cell, which may be NaN.

    Raises :class:`UserError` for a malformed or huge number.
    """
    try:
        found = np.array([decimal(part.strip(" ")) for part in cell.split(";")])
    except ValueError as error:
        raise UserError(f"{where}: {cell!r} is not a list of numbers joined by ';'") from error
    if (np.abs(found) > MAX_NUMBER).any():
        raise UserError(f"{where}: {cell!r} has a number beyond {MAX_NUMBER:g}")
    return found


def score_lines(scores: Sequence[DatasetScore]) -> Iterator[str]:
    """Yield the heads, a row for each dataset, and a row with the mean score."""
    yield f"{'dataset':<24}{'mAA':>9}{'clusters':>10}{'score':>9}"
    for each in scores:
        yield f"{shown(each.dataset):<24}{each.maa:>9.4f}{each.clusterness:>10.4f}{each.score:>9.4f}"
    yield f"{'mean':<43}{np.mean([each.score for each in scores]):>9.4f}"
