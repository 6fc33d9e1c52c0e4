"""The score of the Image Matching Challenge 2025: are mixed images in the right clusters, with the right cameras?

``train_labels.csv`` has ``dataset,scene,image,rotation_matrix,translation_vector``, ``train_thresholds.csv`` has
``dataset,scene,thresholds``; numbers in a cell are joined by ``;``, and poses are world to camera. An image of the
scene ``outliers`` belongs to none.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import read_rows
from mkpc_kaggle.errors import UserError

OUTLIERS = "outliers"
POSE_COLUMNS = ("dataset", "scene", "image", "rotation_matrix", "translation_vector")
SKIPPED_THRESHOLDS = 2  # the finest, which the ground truth cannot tell apart
FREE = 3  # images that any similarity can be made to fit
MAX_TRIPLETS = 20_000  # tried for a scene and a cluster; of more, so many are drawn
REFINEMENTS = 10
MIN_SPREAD = 1e-12  # sum of squares; centres with less stand at one point

Points = NDArray[np.float64]  # (N, 3)
Centres = Mapping[str, Points]  # of the cameras of a scene or cluster by image, (3,); NaN without a camera


@dataclass(frozen=True)
class DatasetScore:
    """``maa`` is pooled over the dataset's scenes; ``clusterness`` is the share of right images in clusters."""

    dataset: str
    maa: float
    clusterness: float

    @property
    def score(self) -> float:
        """The harmonic mean of the two."""
        total = self.maa + self.clusterness
        return 2 * self.maa * self.clusterness / total if total else 0.0


def score_imc2025(directory: Path, submission: Path) -> list[DatasetScore]:
    """The score of each dataset of a train side.

    Raises :class:`UserError` for files that cannot be read, and if an image is missing, unknown or there twice.
    """
    truth, found, path = (
        _poses(directory / "train_labels.csv"),
        _poses(submission),
        directory / "train_thresholds.csv",
    )
    rows = read_rows(path, ("dataset", "scene", "thresholds"))
    limits = {tuple(names): _numbers(cell, f"{path}, line {line}") for line, (*names, cell) in rows}
    for name, scenes in truth.items():
        given = [image for cluster in found.get(name, {}).values() for image in cluster]
        if wrong := {image for scene in scenes.values() for image in scene} ^ set(given):
            raise UserError(
                f"{submission}: {len(wrong)} images of {name} are missing or unknown, such as {min(wrong)}"
            )
        if lacking := [scene for scene in scenes if scene != OUTLIERS and (name, scene) not in limits]:
            raise UserError(f"{path} has no thresholds of {name}/{lacking[0]}")
    return [
        score_dataset(
            name, scenes, found[name], {scene: limits.get((name, scene), np.zeros(0)) for scene in scenes}
        )
        for name, scenes in truth.items()
    ]


def score_dataset(
    name: str,
    scenes: Mapping[str, Centres],
    clusters: Mapping[str, Centres],
    thresholds: Mapping[str, Sequence[float] | Points],
) -> DatasetScore:
    """Each scene takes the cluster that has most of its images, of several the cluster with the best mAA.

    The mAA's numerators and denominators are summed over the scenes before they are divided.
    """
    accurate = possible = common = taken = 0
    for scene, centres in ((scene, centres) for scene, centres in scenes.items() if scene != OUTLIERS):
        limits = thresholds[scene][SKIPPED_THRESHOLDS:]
        choices = [
            (len(centres.keys() & cluster.keys()), accurate_images(centres, cluster, limits), len(cluster))
            for label, cluster in clusters.items()
            if label != OUTLIERS and centres.keys() & cluster.keys()
        ]
        overlap, count, size = max(choices, key=lambda each: each[:2], default=(0, 0, 0))
        accurate, possible = accurate + count, possible + len(limits) * max(len(centres) - FREE, 0)
        common, taken = common + overlap, taken + size
    return DatasetScore(name, accurate / possible if possible else 0.0, common / taken if taken else 0.0)


def accurate_images(truth: Centres, cluster: Centres, thresholds: Sequence[float] | Points) -> int:
    """How many images more than ``FREE`` have a centre less than a threshold off, summed over thresholds.

    The similarity that takes the cluster to the scene is found for each threshold on its own.
    """
    common = sorted(name for name in truth.keys() & cluster.keys() if np.isfinite(cluster[name]).all())
    if len(common) < FREE:
        return 0
    source, target = (np.array([centres[name] for name in common]) for centres in (cluster, truth))
    return sum(max(fitting(source, target, threshold) - FREE, 0) for threshold in thresholds)


def fitting(source: Points, target: Points, threshold: float) -> int:
    """The most points, (N, 3), that a similarity from ``source`` takes to less than ``threshold`` from ``target``.

    Similarities are those of triplets; the best of them is fitted anew to the points that agree with it.
    """
    triplets, best = _triplets(len(source)), 0
    inside = _distances(*similarities(source[triplets], target[triplets]), source, target) < threshold
    agreeing = inside[inside.sum(axis=1).argmax()]
    for _ in range(REFINEMENTS):
        best = max(best, int(agreeing.sum()))
        if agreeing.sum() < FREE:
            break
        refined = similarities(source[None, agreeing], target[None, agreeing])
        agreeing = _distances(*refined, source, target)[0] < threshold
    return best


def similarities(source: Points, target: Points) -> tuple[Points, Points]:
    """A (B, 3, 3), a rotation times a scale, and t (B, 3) with A x + t nearest to the targets, from (B, N, 3).

    NaN where all sources are one point.

    Source: Umeyama 1991, the solution of Horn's problem by a singular value decomposition.
    """
    means = source.mean(axis=1), target.mean(axis=1)
    x, y = source - means[0][:, None], target - means[1][:, None]
    U, S, Vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    signs = np.ones_like(S)
    signs[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    spread = (x**2).sum(axis=(1, 2))
    scale = np.where(spread < MIN_SPREAD, np.nan, (S * signs).sum(axis=1) / np.maximum(spread, MIN_SPREAD))
    A = scale[:, None, None] * (U * signs[:, None]) @ Vt
    return A, means[1] - np.einsum("bij,bj->bi", A, means[0])


def _distances(A: Points, t: Points, source: Points, target: Points) -> NDArray[np.float64]:
    """(B, N): how far each similarity takes each point from its target."""
    moved = np.einsum("bij,nj->bni", A, source) + t[:, None]
    return np.asarray(np.linalg.norm(moved - target, axis=2))


def _triplets(count: int) -> NDArray[np.intp]:
    if count * (count - 1) * (count - 2) // 6 <= MAX_TRIPLETS:
        return np.array(list(combinations(range(count), 3)), np.intp)
    drawn = np.random.default_rng(0).random((MAX_TRIPLETS, count))
    return np.argpartition(drawn, 3, axis=1)[:, :3]


def _poses(path: Path) -> dict[str, dict[str, dict[str, Points]]]:
    """The camera centres of a table of poses: by dataset, scene or cluster, and image."""
    found: dict[str, dict[str, dict[str, Points]]] = {}
    seen: set[tuple[str, str]] = set()
    for where, (dataset, scene, image, *cells) in read_rows(path, POSE_COLUMNS):
        if (dataset, image) in seen:
            raise UserError(f"{where}: the image {dataset}/{image} is there twice")
        seen.add((dataset, image))
        R, t = (_numbers(cell, where) for cell in cells)
        if (len(R), len(t)) != (9, 3):
            raise UserError(f"{where}: expected 9 and 3 numbers joined by ';', found {len(R)} and {len(t)}")
        found.setdefault(dataset, {}).setdefault(scene, {})[image] = -R.reshape(3, 3).T @ t
    return found


def _numbers(cell: str, where: str) -> Points:
    try:
        return np.array([float(part) for part in cell.split(";")])
    except ValueError as error:
        raise UserError(f"{where}: {cell!r} is not a list of numbers joined by ';'") from error


def score_lines(scores: Sequence[DatasetScore]) -> Iterator[str]:
    """Lines: a row for each dataset, and their mean."""
    yield f"{'dataset':<24}{'mAA':>9}{'clusters':>10}{'score':>9}"
    for each in scores:
        yield f"{each.dataset:<24}{each.maa:>9.4f}{each.clusterness:>10.4f}{each.score:>9.4f}"
    yield f"{'mean':<43}{np.mean([each.score for each in scores]):>9.4f}"
