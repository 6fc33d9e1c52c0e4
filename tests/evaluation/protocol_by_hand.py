"""SuperGlue's evaluation in NumPy and OpenCV alone: an independent check of the package, which it does not import.

Points are in pixels of the stored images; pictures are resized to a long side before they are matched. Resizing
scales points and K alike and leaves rays as they are. Here they come from the stored image: the pose of five
matches that nearly coincide depends on the last bit.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np


def evaluate(
    line: str, points: Sequence[Any], keypoints: int, sizes: Sequence[Sequence[int]], side: int
) -> dict[str, Any]:
    """Return pose, errors in degrees, precision and matching score of a pair of a list."""
    numbers = np.array(line.split()[4:], float)
    T = numbers[18:].reshape(4, 4)
    rays, focals = [], []
    for K, found, size in zip(numbers[:18].reshape(2, 3, 3), points, sizes, strict=True):
        rays.append((np.column_stack([found, np.ones(len(found))]) @ np.linalg.inv(K).T)[:, :2])
        focals += [K[axis, axis] * round(size[axis] * side / max(size)) / size[axis] for axis in (0, 1)]
    R, t = in_front(rays, 1 / np.mean(focals))
    correct = squared_distances(rays, T) < 5e-4
    return {
        "R": R,
        "t": t,
        "rotation": np.inf if R is None else angle((np.trace(R.T @ T[:3, :3]) - 1) / 2),
        "translation": np.inf if t is None else angle(abs(t @ T[:3, 3]) / np.linalg.norm(T[:3, 3])),
        "precision": correct.mean() if len(correct) else 0,
        "matching_score": correct.sum() / keypoints if keypoints else 0,
    }


def in_front(rays: Sequence[Any], threshold: float) -> tuple[Any, Any]:
    """Return the rotation and the unit translation of E that put most inliers in front of both cameras."""
    best: tuple[int, Any, Any] = (0, None, None)
    if len(rays[0]) < 5:
        return best[1:]
    stacked, mask = cv2.findEssentialMat(*rays, np.eye(3), method=cv2.RANSAC, prob=0.99999, threshold=threshold)
    for E in [] if stacked is None else np.split(stacked, len(stacked) // 3):
        count, R, t, *_ = cv2.recoverPose(E, *rays, np.eye(3), 1e9, mask=mask.copy())
        best = max(best, (count, R, t.ravel()), key=lambda pose: pose[0])
    return best[1:]


def squared_distances(rays: Sequence[Any], T: Any) -> Any:
    """Return the squared distances to the epipolar lines of the true pose, summed over both pictures."""
    x, y, z = T[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T[:3, :3]
    p0, p1 = (np.column_stack([found, np.ones(len(found))]) for found in rays)
    lines1, lines0 = p0 @ E.T, p1 @ E
    residuals = np.sum(p1 * lines1, axis=1) ** 2
    return residuals * (1 / np.sum(lines1[:, :2] ** 2, axis=1) + 1 / np.sum(lines0[:, :2] ** 2, axis=1))


def angle(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def auc(errors: Sequence[float], limit: float) -> float:
    """Return the area under the recall of the errors, linear between them, up to a limit in degrees."""
    area, last = 0.0, 0.0
    for number, error in enumerate(sorted(error for error in errors if error < limit)):
        area, last = area + (error - last) * (number + 0.5), error
    return (area + (limit - last) * sum(error < limit for error in errors)) / (limit * len(errors))
