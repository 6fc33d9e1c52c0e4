"""Two-view models from matches: F, E or H by MAGSAC++, and the poses that an F stands for.

An estimate is always a value: where no model can be had, it says why and carries the fallback matrix, which
is finite and of the right rank, so that a submission never has a hole.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import AT_LEAST_1, POSITIVE, Range, check_ranges
from mkpc_kaggle.geometry.matches import Matches

Matrix3 = NDArray[np.float64]

FALLBACK_FUNDAMENTAL: Matrix3 = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The F of a pure sideways motion, [e_x]_x: finite, rank 2; epipolar lines are the image rows."""
FALLBACK_FUNDAMENTAL.setflags(write=False)


class Model(StrEnum):
    """The two-view model to estimate: fundamental matrix, essential matrix, homography."""

    F = "F"
    E = "E"
    H = "H"

    @property
    def least_matches(self) -> int:
        """How many distinct matches an estimate needs here (one more than the minimal F, to tell a model)."""
        return {Model.F: 8, Model.E: 6, Model.H: 5}[self]

    @property
    def fallback(self) -> Matrix3:
        return np.eye(3) if self is Model.H else FALLBACK_FUNDAMENTAL.copy()


class Method(StrEnum):
    """The robust estimator of OpenCV."""

    MAGSAC = "magsac"
    RANSAC = "ransac"

    @property
    def flag(self) -> int:
        return cv2.USAC_MAGSAC if self is Method.MAGSAC else cv2.RANSAC


@dataclass(frozen=True)
class RobustConfig:
    """Settings of :func:`estimate`: the threshold in image pixels, the confidence, the iteration limit.

    The estimator stops by chance before it has found the best model, and where depends on the order of the
    matches: it is run on ``orders`` fixed permutations of them, and the model with most inliers is kept.
    """

    method: Method = Method.MAGSAC
    threshold: float = 0.2
    confidence: float = 0.99999
    max_iterations: int = 50_000
    orders: int = 8

    def __post_init__(self) -> None:
        check_ranges(self, threshold=POSITIVE, confidence=Range(0, 1, "()"), max_iterations=Range(1, 2**31 - 1))
        check_ranges(self, orders=AT_LEAST_1)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A two-view model of one pair.

    ``matrix`` is (3, 3) float64, finite, of unit Frobenius norm; for F, x1^T F x0 = 0 in homogeneous image
    pixels. ``inliers`` is an (N,) mask over the matches that were given. ``failure`` is empty, or says why
    ``matrix`` is only the fallback.
    """

    model: Model
    matrix: Matrix3
    inliers: NDArray[np.bool_]
    failure: str = ""

    @property
    def ok(self) -> bool:
        return not self.failure

    @property
    def inlier_count(self) -> int:
        return int(self.inliers.sum())

    @classmethod
    def failed(cls, model: Model, count: int, reason: str) -> "Estimate":
        """The fallback for ``count`` matches, with the reason."""
        matrix = model.fallback
        return cls(model, matrix / np.linalg.norm(matrix), np.zeros(count, bool), reason)


def estimate(
    matches: Matches,
    config: RobustConfig,
    model: Model = Model.F,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> Estimate:
    """The model of ``model``'s kind that ``matches`` (image pixels) agree on.

    Non-finite points and exact repetitions are set aside first; an inlier's repetitions are inliers too. E
    needs the two camera matrices, (3, 3) each: the points are then calibrated and the threshold is divided
    by the mean focal length. Raises ``ValueError`` for E without intrinsics; whatever the points are, the
    answer is an :class:`Estimate`. The same input gives the same bytes.
    """
    if model is Model.E and intrinsics is None:
        raise ValueError("an essential matrix needs the intrinsics of both cameras")
    pairs = np.hstack([matches.points0, matches.points1]).astype(np.float64)
    finite = np.flatnonzero(np.isfinite(pairs).all(axis=1))
    distinct, representative = _distinct(pairs[finite])
    if len(distinct) < model.least_matches:
        return Estimate.failed(model, len(matches), f"too few distinct matches for {model}: {len(distinct)}")
    points0, points1, threshold = distinct[:, :2], distinct[:, 2:], config.threshold
    if intrinsics is not None and model is Model.E:
        points0, points1 = calibrate(points0, intrinsics[0]), calibrate(points1, intrinsics[1])
        threshold /= np.mean([intrinsics[i][j, j] for i in (0, 1) for j in (0, 1)])
    try:
        matrix, mask = _best_of_orders(model, points0, points1, threshold, config)
    except cv2.error as error:
        return Estimate.failed(model, len(matches), f"OpenCV refused the points: {error.err}")
    if matrix is None:
        return Estimate.failed(model, len(matches), f"no {model} fits {len(distinct)} distinct matches")
    inliers = np.zeros(len(matches), bool)
    inliers[finite] = mask[representative]
    if not inliers.any():
        return Estimate.failed(model, len(matches), f"no {model} has inliers among {len(distinct)} matches")
    return Estimate(model, matrix / np.linalg.norm(matrix), inliers)


def calibrate(points: NDArray[np.float64], K: Matrix3) -> NDArray[np.float64]:
    """(N, 2) pixels -> (N, 2) coordinates in the plane z = 1 of the camera with matrix K."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(K).T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def poses_of_fundamental(F: Matrix3, K0: Matrix3, K1: Matrix3) -> tuple[tuple[Matrix3, Matrix3], Matrix3]:
    """The two rotations, and the translation of unit length and unknown sign, that an F stands for.

    X_1 = R X_0 + t takes camera 0 to camera 1. Which rotation and sign hold, only points in front of both
    cameras can tell. Source: Hartley and Zisserman, Multiple View Geometry, 9.6.2.
    """
    rotation_a, rotation_b, translation = cv2.decomposeEssentialMat(K1.T @ F @ K0)
    rotations = np.asarray(rotation_a, np.float64), np.asarray(rotation_b, np.float64)
    return rotations, np.asarray(translation, np.float64).ravel()


def epipolar_distances(F: Matrix3, matches: Matches) -> NDArray[np.float64]:
    """(N,) symmetric epipolar distance in pixels: the larger of the distances to the two epipolar lines."""
    homogeneous0, homogeneous1 = (
        np.column_stack([points.astype(np.float64), np.ones(len(matches))])
        for points in (matches.points0, matches.points1)
    )
    lines1, lines0 = homogeneous0 @ F.T, homogeneous1 @ F
    residual = np.abs(np.sum(homogeneous1 * lines1, axis=1))
    shortest = np.minimum(np.hypot(*lines0[:, :2].T), np.hypot(*lines1[:, :2].T))
    return np.asarray(residual / np.maximum(shortest, np.finfo(np.float64).tiny))


def sampson_distances(F: Matrix3, matches: Matches) -> NDArray[np.float64]:
    """(N,) Sampson distance in pixels: that by which OpenCV tells inliers of an F.

    Source: Hartley and Zisserman, Multiple View Geometry, 11.4.3.
    """
    homogeneous0, homogeneous1 = (
        np.column_stack([points.astype(np.float64), np.ones(len(matches))])
        for points in (matches.points0, matches.points1)
    )
    lines1, lines0 = homogeneous0 @ F.T, homogeneous1 @ F
    residual = np.abs(np.sum(homogeneous1 * lines1, axis=1))
    slope = np.hypot(np.hypot(*lines0[:, :2].T), np.hypot(*lines1[:, :2].T))
    return np.asarray(residual / np.maximum(slope, np.finfo(np.float64).tiny))


def _distinct(pairs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The distinct rows of (N, 4) pairs in order of first appearance, and for each row its place there, (N,)."""
    _, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return pairs[np.sort(first)], place[inverse.ravel()]


def _best_of_orders(
    model: Model,
    points0: NDArray[np.float64],
    points1: NDArray[np.float64],
    threshold: float,
    config: RobustConfig,
) -> tuple[Matrix3 | None, NDArray[np.bool_]]:
    """The model with most inliers over fixed permutations, the given order first, and its mask (N,).

    OpenCV now and then refuses points in one order and not in another; raises its error where it refused some
    and the others gave nothing.
    """
    best, best_mask, refusal = None, np.zeros(len(points0), bool), None
    for number in range(config.orders):
        order = np.random.default_rng(number).permutation(len(points0)) if number else np.arange(len(points0))
        try:
            matrix, mask = _solve(model, points0[order], points1[order], threshold, config)
        except cv2.error as error:
            refusal = error
            continue
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not matrix.any():
            continue
        if best is None or np.count_nonzero(mask) > np.count_nonzero(best_mask):
            best, best_mask[order] = matrix, mask.ravel().astype(bool)
    if best is None and refusal is not None:
        raise refusal
    return best, best_mask


def _solve(
    model: Model,
    points0: NDArray[np.float64],
    points1: NDArray[np.float64],
    threshold: float,
    config: RobustConfig,
) -> tuple[Matrix3 | None, NDArray[np.uint8]]:
    flag, confidence, limit = config.method.flag, config.confidence, config.max_iterations
    match model:
        case Model.F:
            answer = cv2.findFundamentalMat(points0, points1, flag, threshold, confidence, limit)
        case Model.E:
            answer = cv2.findEssentialMat(points0, points1, np.eye(3), flag, confidence, threshold, limit)
        case Model.H:
            answer = cv2.findHomography(points0, points1, flag, threshold, maxIters=limit, confidence=confidence)
    # OpenCV's stubs promise arrays; without a model they are None.
    return cast(tuple[Matrix3 | None, NDArray[np.uint8]], answer)
