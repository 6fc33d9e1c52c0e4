"""Two-view models from matches: F, E or H by MAGSAC++.

MAGSAC's threshold is :attr:`RobustConfig.threshold`, ``[magsac] threshold`` of a recipe: 0.2 px of the stored
image, which no shipped recipe changes. For an E it is divided by the mean focal length. With ``[focal]``, F
is refined by that table's ``scale``, and this threshold counts the inliers.

Other limits, in pixels of the stored image, are for other purposes: 0.4 for rough starts under a prior
(``ESSENTIAL_THRESHOLD_PX``), 2.0 for pycolmap's verification (``MAX_ERROR_PX``), 2.0 for matches that speak
against a scene's F (:mod:`mkpc_kaggle.scene.choose`). ``threshold`` in a matcher's table is a confidence.

An estimate always has a matrix. If no model is found, it holds the reason and the fallback matrix,
which is finite and of the right rank. So a submission is always complete.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import POSITIVE, Range, check_ranges
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.two_view import Vectors, sampson

# The second and third singular value of F, in pixels. MAGSAC's own F, from seven matches, has a
# third value of up to 4e-7 of the second; the second is at least 3e-7 of the first. A false alarm
# would cost a pair its F, so the bounds are far from these.
MAX_THIRD, MIN_SECOND = 0.1, 1e-12
# F of a pure sideways motion, [e_x]_x: finite, rank 2; the epipolar lines are the image rows.
FALLBACK_FUNDAMENTAL: Matrix3 = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
FALLBACK_FUNDAMENTAL.setflags(write=False)
FARTHEST = 1e9  # baselines; farther points do not count as in front of a camera


class ModelKind(StrEnum):
    """The two-view model to estimate: fundamental matrix, essential matrix, homography."""

    F = "F"
    E = "E"
    H = "H"


@dataclass(frozen=True)
class RobustConfig:
    """Settings of :func:`estimate`, table ``[magsac]`` of a recipe."""

    threshold: float = 0.2  # pixels of the stored image
    max_iterations: int = 50_000
    # Probability that no better model remains, where iterations stop
    confidence: float = 0.99999

    def __post_init__(self) -> None:
        check_ranges(self, threshold=POSITIVE, max_iterations=Range(1, 10**6))
        check_ranges(self, confidence=Range(0, 1, "()"))


@dataclass(frozen=True, eq=False)
class Estimate:
    """A model with its inliers, or the fallback with the reason."""

    model: ModelKind
    # Finite, of unit Frobenius norm; for F, x1^T F x0 = 0 in homogeneous image pixels.
    matrix: Matrix3
    inliers: NDArray[np.bool_]  # (N,) mask of the given matches within the threshold
    failure: str = ""  # the reason if ``matrix`` is the fallback
    magsac: Matrix3 | None = None  # under a prior on focal lengths, MAGSAC's own F, if any

    @property
    def ok(self) -> bool:
        return not self.failure

    def __bool__(self) -> bool:
        return self.ok

    @property
    def inlier_count(self) -> int:
        return int(self.inliers.sum())

    @classmethod
    def of_nearest(cls, F: Matrix3, matches: Matches, count: int, failure: str) -> "Estimate":
        """Return an estimate whose inliers are the ``count`` matches that are nearest to F."""
        inliers = np.zeros(len(matches), bool)
        inliers[np.argsort(sampson_distances(F, matches), kind="stable")[:count]] = True
        return cls(ModelKind.F, F, inliers, failure)

    @classmethod
    def failed(cls, model: ModelKind, count: int, reason: str) -> "Estimate":
        """Return the fallback for ``count`` matches, with the reason."""
        return cls(model, unit_norm(_SOLVERS[model].fallback), np.zeros(count, bool), reason)


def estimate(
    matches: Matches,
    config: RobustConfig,
    model: ModelKind = ModelKind.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> Estimate:
    """Estimate a two-view model from ``matches`` (image pixels).

    Ignores non-finite points and exact duplicates. Duplicates of an inlier are
    inliers. E needs both camera matrices (3, 3): the points are calibrated, and the threshold is
    divided by the mean focal length. Raises ``ValueError`` for E without intrinsics, but never
    because of the points. The same input gives the same bytes.
    """
    if model is ModelKind.E and intrinsics is None:
        raise ValueError(
            "an essential matrix needs the intrinsics, the camera matrix K of both images"
        )
    distinct = DistinctMatches.of(matches)
    found = consensus(distinct.points0, distinct.points1, config, model, intrinsics)
    return replace(found, inliers=distinct.mask_of_all(found.inliers))


def consensus(
    points0: Vectors,
    points1: Vectors,
    config: RobustConfig,
    model: ModelKind,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> Estimate:
    """Estimate a model as :func:`estimate` does, from finite points (N, 2), duplicates included."""
    count = len(points0)
    solver = _SOLVERS[model]
    if count < solver.min_matches:
        return Estimate.failed(model, count, f"too few distinct matches for {model}: {count}")
    settings: dict[str, Any] = {
        "method": cv2.USAC_MAGSAC,
        "ransacReprojThreshold": config.threshold,
        "confidence": config.confidence,
        "maxIters": config.max_iterations,
    }
    if intrinsics is not None and model is ModelKind.E:
        points0 = calibrate(points0, intrinsics[0])
        points1 = calibrate(points1, intrinsics[1])
        settings["focal"] = float(
            np.mean([K[axis, axis] for K in intrinsics for axis in (0, 1)])
        )
    try:
        matrix, mask = solver.find(points0, points1, **settings)
    except cv2.error as error:
        return Estimate.failed(model, count, f"OpenCV refused the points: {error.err}")
    if not _is_model(matrix):
        return Estimate.failed(model, count, f"no {model} fits {count} distinct matches")
    inliers = mask.ravel().astype(bool)
    if not inliers.any():
        failure = f"no {model} has inliers among {count} distinct matches"
        return Estimate.failed(model, count, failure)
    return Estimate(model, unit_norm(matrix), inliers)


def _is_model(matrix: Any) -> bool:
    """Return whether OpenCV returned one finite matrix (3, 3) other than zero."""
    if matrix is None or matrix.shape != (3, 3):
        return False
    return bool(np.isfinite(matrix).all() and matrix.any())


def is_fundamental(matrix: NDArray[np.float64]) -> bool:
    """Return whether a matrix (3, 3) is finite and of rank 2."""
    if not np.isfinite(matrix).all():
        return False
    first, second, third = np.linalg.svd(matrix, compute_uv=False)
    return bool(second > MIN_SECOND * first and third < MAX_THIRD * second)


@dataclass(frozen=True, eq=False)
class DistinctMatches:
    """The distinct finite matches of N, in order of first appearance."""

    points0: Vectors  # (M, 2)
    points1: Vectors
    index: NDArray[np.intp]  # (N,) the row of each match, -1 for a match that is not finite

    @classmethod
    def of(cls, matches: Matches) -> "DistinctMatches":
        pairs = np.hstack([matches.points0, matches.points1]).astype(np.float64)
        finite = np.isfinite(pairs).all(axis=1)
        first, inverse = _distinct_rows(pairs[finite])
        # The order is that of the values; MAGSAC needs that of the matches. ``rank`` is the row of
        # each value in the order of first appearance.
        rank = np.argsort(np.argsort(first))
        index = np.full(len(pairs), -1)
        index[finite] = rank[inverse]
        pairs = pairs[finite][np.sort(first)]
        return cls(pairs[:, :2], pairs[:, 2:], index)

    def mask_of_all(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Expand a mask (M,) of the distinct matches to all N matches, duplicates included."""
        # Index -1, of a match that is not finite, reads the appended False.
        return np.append(mask, False)[self.index]


def _distinct_rows(rows: Vectors) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first row (M,) of each distinct row, sorted by value, and the number (N,) of each
    row's value.

    As ``np.unique(rows, axis=0)``, in a third of its time.
    """
    # The last key is the first to sort by; equal rows stay in their order.
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_first = np.ones(len(rows), bool)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    inverse = np.empty(len(rows), np.intp)
    inverse[order] = np.cumsum(is_first) - 1
    return order[is_first], inverse


def unit_norm(matrix: Matrix3) -> Matrix3:
    """Scale to unit Frobenius norm."""
    return np.asarray(matrix / np.linalg.norm(matrix))


def calibrate(points: NDArray[np.floating], K: Matrix3) -> Vectors:
    """Convert (N, 2) pixels to (N, 2) coordinates in the plane z = 1 of a camera with matrix K."""
    mapped = homogeneous(points) @ np.linalg.inv(K).T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def sampson_distances(F: Matrix3, matches: Matches) -> Vectors:
    """Return (N,) Sampson distances in pixels; OpenCV compares these with the threshold of F.

    Source: Hartley and Zisserman, Multiple View Geometry, 11.4.3.
    """
    rays0 = homogeneous(matches.points0.astype(np.float64))
    rays1 = homogeneous(matches.points1.astype(np.float64))
    return np.abs(sampson(F, rays0, rays1))


def homogeneous(points: NDArray[np.floating]) -> Vectors:
    """Append a 1 to each point: (N, 2) -> (N, 3)."""
    return np.column_stack([points, np.ones(len(points))])


class _Solver(NamedTuple):
    """OpenCV's function for a model, with its limit."""

    min_matches: int  # more than a minimal sample, so that matches can contradict the model
    fallback: Matrix3
    find: Callable[..., Any]  # returns OpenCV's matrix (``None`` without a model) and mask


def _find_fundamental(points0: Vectors, points1: Vectors, **settings: Any) -> Any:
    """Find F: return OpenCV's matrix and mask. A matrix of rank 3, of some sets of wrong matches, is none."""
    found: Any = cv2.findFundamentalMat(points0, points1, **settings)
    matrix, mask = found
    if _is_model(matrix) and not is_fundamental(matrix):
        return None, mask
    return matrix, mask


def _find_essential(
    points0: Vectors, points1: Vectors, confidence: float, focal: float, **settings: Any
) -> Any:
    """Find E from calibrated points (N, 2): return OpenCV's matrix and mask."""
    # MAGSAC integrates its score up to a fixed number of pixels, so it needs points in pixels.
    settings["threshold"] = settings.pop("ransacReprojThreshold")
    K = np.diag([focal, focal, 1.0])
    stacked, mask = cv2.findEssentialMat(
        focal * points0, focal * points1, K, prob=confidence, **settings
    )
    if stacked is None or len(stacked) <= 3:
        return stacked, mask

    def in_front(E: Any) -> int:
        """Count the points in front of both cameras."""
        return int(cv2.recoverPose(E, points0, points1, np.eye(3), FARTHEST)[0])

    # Five points have up to ten solutions, which OpenCV stacks.
    solutions = np.split(stacked, len(stacked) // 3)
    return max(solutions, key=in_front), mask


_SOLVERS = {
    ModelKind.F: _Solver(8, FALLBACK_FUNDAMENTAL, _find_fundamental),
    ModelKind.E: _Solver(6, FALLBACK_FUNDAMENTAL, _find_essential),
    ModelKind.H: _Solver(5, np.eye(3), cv2.findHomography),
}
