"""Two-view models from matches: F, E or H by MAGSAC++, and the poses that an F stands for.

An estimate is always a value: where no model is found, it has the reason and the fallback matrix, which is
finite and of the right rank, so that a submission is always complete.
"""

from dataclasses import dataclass, replace
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
    matches: it is run on ``orders`` fixed permutations of them, and the model of the lowest :func:`robust_cost`
    at twice the threshold is kept.
    """

    method: Method = Method.MAGSAC
    threshold: float = 0.2
    confidence: float = 0.99999
    max_iterations: int = 50_000
    orders: int = 8

    def __post_init__(self) -> None:
        check_ranges(self, threshold=POSITIVE, confidence=Range(0, 1, "()"), max_iterations=Range(1, 2**31 - 1))
        check_ranges(self, orders=AT_LEAST_1)


class Origin(StrEnum):
    """Which candidate an estimate comes from."""

    MAGSAC = "MAGSAC"
    """the robust estimator's model as it is"""
    FROM_F = "F, refined"
    """MAGSAC's F, refined under the prior on the focal lengths"""
    FROM_E = "E, refined"
    """MAGSAC's E at the prior's focal lengths, or at the known ones, refined"""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A two-view model of one pair.

    ``matrix`` is (3, 3) float64, finite, of unit Frobenius norm; for F, x1^T F x0 = 0 in homogeneous image
    pixels. ``inliers`` is an (N,) mask over the matches that were given: those nearer than the threshold.
    ``failure`` is empty, or says why ``matrix`` is only the fallback. ``focals`` are the focal lengths in pixels
    that it stands for, ``None`` without a prior; ``magsac`` is the (3, 3) F that MAGSAC alone gives,
    ``None`` without a prior and where it gives none; ``remark`` is a warning about it, or empty.
    """

    model: Model
    matrix: Matrix3
    inliers: NDArray[np.bool_]
    failure: str = ""
    origin: Origin = Origin.MAGSAC
    focals: tuple[float, float] | None = None
    magsac: Matrix3 | None = None
    remark: str = ""

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

    Non-finite points and exact duplicates are left out first; an inlier's duplicates are inliers too. E
    needs the two camera matrices, (3, 3) each: the points are then calibrated and the threshold is divided
    by the mean focal length. Raises ``ValueError`` for E without intrinsics, and never on account of the
    points. The same input gives the same bytes.
    """
    if model is Model.E and intrinsics is None:
        raise ValueError("an essential matrix needs the intrinsics of both cameras")
    distinct = DistinctMatches.of(matches)
    found = consensus(distinct.points0, distinct.points1, config, model, intrinsics)
    return replace(found, inliers=distinct.mask_of_all(found.inliers))


def consensus(
    points0: NDArray[np.float64],
    points1: NDArray[np.float64],
    config: RobustConfig,
    model: Model,
    intrinsics: tuple[Matrix3, Matrix3] | None = None,
) -> Estimate:
    """:func:`estimate` for (N, 2) finite points without duplicates."""
    count, threshold = len(points0), config.threshold
    if count < model.least_matches:
        return Estimate.failed(model, count, f"too few distinct matches for {model}: {count}")
    if intrinsics is not None and model is Model.E:
        points0, points1 = calibrate(points0, intrinsics[0]), calibrate(points1, intrinsics[1])
        threshold /= float(np.mean([K[axis, axis] for K in intrinsics for axis in (0, 1)]))
    try:
        matrix, mask = _best_of_orders(model, points0, points1, threshold, config)
    except cv2.error as error:
        return Estimate.failed(model, count, f"OpenCV refused the points: {error.err}")
    if matrix is None:
        return Estimate.failed(model, count, f"no {model} fits {count} distinct matches")
    if not mask.any():
        return Estimate.failed(model, count, f"no {model} has inliers among {count} distinct matches")
    return Estimate(model, matrix / np.linalg.norm(matrix), mask)


@dataclass(frozen=True, eq=False)
class DistinctMatches:
    """The (M, 2) finite distinct matches among N, in order of first appearance.

    ``finite`` are the indices of the finite matches, ``place`` the row in ``points0`` and ``points1`` of each.
    """

    points0: NDArray[np.float64]
    points1: NDArray[np.float64]
    count: int
    finite: NDArray[np.intp]
    place: NDArray[np.intp]

    @classmethod
    def of(cls, matches: Matches) -> "DistinctMatches":
        pairs = np.hstack([matches.points0, matches.points1]).astype(np.float64)
        finite = np.flatnonzero(np.isfinite(pairs).all(axis=1))
        _, first, inverse = np.unique(pairs[finite], axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        pairs = pairs[finite][first[order]]
        return cls(pairs[:, :2], pairs[:, 2:], len(matches), finite, place[inverse.ravel()])

    def mask_of_all(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """An (M,) mask of the distinct matches as an (N,) one of all: duplicates are like the first."""
        whole = np.zeros(self.count, bool)
        whole[self.finite] = mask[self.place]
        return whole


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


def sampson_distances(F: Matrix3, matches: Matches) -> NDArray[np.float64]:
    """(N,) Sampson distance in pixels; OpenCV's inliers of an F have it below the threshold.

    Source: Hartley and Zisserman, Multiple View Geometry, 11.4.3.
    """
    return _distances(Model.F, F, matches.points0.astype(np.float64), matches.points1.astype(np.float64))


def robust_cost(distances: NDArray[np.float64], scale: float) -> float:
    """The sum of :func:`robust_costs`."""
    return float(np.sum(robust_costs(distances, scale)))


def robust_costs(distances: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """x^2 / (2 (1 + x^2)), x = distance / scale: Geman and McClure, 1985. An outlier costs a half."""
    return np.asarray(0.5 - 0.5 / (1 + np.square(distances / scale)))


def _distances(
    model: Model, matrix: Matrix3, points0: NDArray[np.float64], points1: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) Sampson distances to an F or E; distances in the second image to where an H takes the points."""
    homogeneous0, homogeneous1 = (np.column_stack([points, np.ones(len(points))]) for points in (points0, points1))
    mapped = homogeneous0 @ matrix.T
    tiny = np.finfo(np.float64).tiny
    if model is Model.H:
        depth = np.where(np.abs(mapped[:, 2:]) > tiny, mapped[:, 2:], tiny)
        return np.asarray(np.hypot(*(mapped[:, :2] / depth - points1).T))
    lines0 = homogeneous1 @ matrix
    residual = np.abs(np.sum(homogeneous1 * mapped, axis=1))
    slope = np.hypot(np.hypot(*lines0[:, :2].T), np.hypot(*mapped[:, :2].T))
    return np.asarray(residual / np.maximum(slope, tiny))


def nth_order(number: int, count: int) -> NDArray[np.intp]:
    """A fixed permutation of ``count`` matches; number 0 is the order in which they are."""
    return np.random.default_rng(number).permutation(count) if number else np.arange(count)


def _best_of_orders(
    model: Model,
    points0: NDArray[np.float64],
    points1: NDArray[np.float64],
    threshold: float,
    config: RobustConfig,
) -> tuple[Matrix3 | None, NDArray[np.bool_]]:
    """The model of the lowest robust cost over fixed permutations, the given order first, and its mask (N,).

    Not the one with most inliers: MAGSAC's score depends on distances up to several times the threshold.
    OpenCV sometimes rejects points in one order and not in another; its error is raised if no order gave a model.
    """
    best, best_mask, least, refusal = None, np.zeros(len(points0), bool), np.inf, None
    for number in range(config.orders):
        order = nth_order(number, len(points0))
        try:
            matrix, mask = _solve(model, points0[order], points1[order], threshold, config)
        except cv2.error as error:
            refusal = error
            continue
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not matrix.any():
            continue
        with np.errstate(over="ignore", invalid="ignore"):  # points may be anything
            cost = robust_cost(_distances(model, matrix, points0, points1), 2 * threshold)
        if best is None or cost < least:
            best, best_mask[order], least = matrix, mask.ravel().astype(bool), cost
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
