"""SuperGlue's evaluation in NumPy and OpenCV alone: an independent check of the package, which it
does not import.

Points are in pixels of the stored images; pictures are resized to a long side before they are
matched. Rays come from the stored image: the pose of five matches that nearly coincide depends on
the last bit.
"""

import cv2
import numpy as np


def evaluate(line, points, keypoints, sizes, side):
    """Return pose, errors in degrees, precision and matching score of a pair of a list."""
    numbers = np.array(line.split()[4:], float)
    Ks, T = numbers[:18].reshape(2, 3, 3), numbers[18:].reshape(4, 4)
    rays = [
        np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
        for K, x in zip(Ks, points, strict=True)
    ]
    scales = [[round(pixels * side / max(size)) / pixels for pixels in size] for size in sizes]
    R, t = in_front(
        [p[:, :2] for p in rays], 1 / np.mean([K.diagonal()[:2] for K in Ks] * np.array(scales))
    )
    E = np.cross(np.eye(3), T[:3, 3]) @ T[:3, :3]
    lines = rays[1] @ E, rays[0] @ E.T
    distances = [
        np.sum(rays[1] * lines[1], axis=1) ** 2 / np.sum(line[:, :2] ** 2, axis=1) for line in lines
    ]
    correct = np.sum(distances, axis=0) < 5e-4
    return {
        "R": R,
        "t": t,
        "rotation": np.inf if R is None else angle((np.trace(R.T @ T[:3, :3]) - 1) / 2),
        "translation": np.inf if R is None else angle(abs(t @ T[:3, 3]) / np.linalg.norm(T[:3, 3])),
        "precision": correct.mean() if len(correct) else 0,
        "matching_score": correct.sum() / keypoints if keypoints else 0,
    }


def in_front(rays, threshold):
    """Return the rotation and the unit translation of E that put most inliers in front of both
    cameras.
    """
    known = {"method": cv2.RANSAC, "prob": 0.99999, "threshold": threshold}
    stacked, mask = (
        cv2.findEssentialMat(*rays, np.eye(3), **known) if len(rays[0]) >= 5 else (None, None)
    )
    found = [] if stacked is None else np.split(stacked, len(stacked) // 3)
    poses = [cv2.recoverPose(E, *rays, np.eye(3), 1e9, mask=mask.copy())[:3] for E in found]
    count, R, t = max(poses, key=lambda pose: pose[0], default=(0, None, None))
    return (R, t.ravel()) if count else (None, None)


def angle(cosine):
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def auc(errors, limit):
    """Return the area under the recall of the errors, linear between them, up to a limit in
    degrees.
    """
    x = np.sort([0.0, *(error for error in errors if error < limit)])
    areas = np.append(np.arange(len(x) - 1) + 0.5, len(x) - 1) * np.diff(x, append=limit)
    return areas.sum() / (limit * len(errors))
