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
    Ks = numbers[:18].reshape(2, 3, 3)
    pose = numbers[18:].reshape(4, 4)
    true_R = pose[:3, :3]
    true_t = pose[:3, 3]
    rays = []
    focals = []
    for K, x, size in zip(Ks, points, sizes, strict=True):
        homogeneous = np.column_stack([x, np.ones(len(x))])
        rays.append(homogeneous @ np.linalg.inv(K).T)
        # SuperGlue's script rounds the sides of the resized picture and scales K by the result.
        scale = [round(pixels * side / max(size)) / pixels for pixels in size]
        focals.append(K.diagonal()[:2] * scale)
    # A pixel over the mean of the four focal lengths.
    R, t = in_front([x[:, :2] for x in rays], 1 / np.mean(focals))
    E = np.cross(np.eye(3), true_t) @ true_R
    rays0, rays1 = rays
    lines0 = rays1 @ E
    lines1 = rays0 @ E.T
    residual = np.sum(rays1 * lines1, axis=1) ** 2
    distance0 = residual / np.sum(lines0[:, :2] ** 2, axis=1)
    distance1 = residual / np.sum(lines1[:, :2] ** 2, axis=1)
    correct = distance0 + distance1 < 5e-4
    rotation = np.inf
    translation = np.inf
    if R is not None:
        rotation = angle((np.trace(R.T @ true_R) - 1) / 2)
        # The sign of t is free.
        translation = angle(abs(t @ true_t) / np.linalg.norm(true_t))
    return {
        "R": R,
        "t": t,
        "rotation": rotation,
        "translation": translation,
        "precision": correct.mean() if len(correct) else 0,
        "matching_score": correct.sum() / keypoints if keypoints else 0,
    }


def in_front(rays, threshold):
    """Return the rotation and the unit translation of E that put most inliers in front of both
    cameras.
    """
    if len(rays[0]) < 5:
        return None, None
    known = {"method": cv2.RANSAC, "prob": 0.99999, "threshold": threshold}
    stacked, mask = cv2.findEssentialMat(*rays, np.eye(3), **known)
    if stacked is None:
        return None, None
    best = (0, None, None)
    for E in np.split(stacked, len(stacked) // 3):  # five points have up to ten solutions
        # OpenCV changes the mask.
        found = cv2.recoverPose(E, *rays, np.eye(3), 1e9, mask=mask.copy())
        count, R, t, _ = found[:4]
        if count > best[0]:
            best = (count, R, t.ravel())
    return best[1:]


def angle(cosine):
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def auc(errors, limit):
    """Return the area under the recall of the errors, linear between them, up to a limit in
    degrees.
    """
    x = np.sort([0.0, *(error for error in errors if error < limit)])
    found = len(x) - 1
    # Trapezoids between the errors, then a rectangle up to the limit.
    heights = np.append(np.arange(found) + 0.5, found)
    return (heights * np.diff(x, append=limit)).sum() / (limit * len(errors))
