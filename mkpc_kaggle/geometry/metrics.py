"""Scores: the mean average accuracy of the Image Matching Challenge 2022, and the pose AUC."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

import cv2
import numpy as np

from mkpc_kaggle.geometry.cameras import Camera, relative_pose
from mkpc_kaggle.geometry.coordinates import Matrix3

# The competition's rules. The i-th rotation threshold, degrees, goes with the i-th translation
# threshold, metres.
ROTATION_THRESHOLDS = np.linspace(1, 10, 10)
TRANSLATION_THRESHOLDS = np.geomspace(0.2, 5, 10)
AUC_THRESHOLDS = (5.0, 10.0, 20.0)  # degrees


@dataclass(frozen=True)
class PoseError:
    """The error of an F's relative pose; infinite without an F."""

    rotation: float  # degrees
    translation_angle: float  # degrees, at most 90, since F leaves the sign open
    # Metres, after scaling to the true length; NaN if the scale of the world is unknown.
    translation: float

    @classmethod
    def failed(cls) -> "PoseError":
        return cls(inf, inf, inf)

    def __str__(self) -> str:
        if not isfinite(self.rotation):
            return "no pose"
        shift = f"{self.translation_angle:.1f} degrees"
        if isfinite(self.translation):
            shift = f"{self.translation:.2f} m"
        return f"rotation {self.rotation:.1f} degrees off, translation {shift}"

    @property
    def angle(self) -> float:
        """The larger of the two angular errors, in degrees, as in the pose AUC."""
        return max(self.rotation, self.translation_angle)


def pose_error(
    F: Matrix3, camera0: Camera, camera1: Camera, metres_per_unit: float
) -> PoseError:
    """Return the pose error of F.

    A submission has no points to select one of F's two rotations. So the rotation nearer to the
    truth counts. The sign of the translation is ignored.
    """
    R, t = relative_pose(camera0, camera1)
    # Two rotations, and a direction (3, 1) of unknown sign (Hartley and Zisserman, Multiple View
    # Geometry, 9.6.2).
    *rotations, column = cv2.decomposeEssentialMat(camera1.K.T @ F @ camera0.K)
    direction = np.ravel(column).astype(np.float64)
    length = float(np.linalg.norm(t))
    cosine = abs(float(direction @ t)) / max(length, np.finfo(float).tiny)
    # F leaves the length open, so the true one is taken.
    scaled = direction * length
    apart = float(np.linalg.norm(scaled - t))
    apart = min(apart, float(np.linalg.norm(scaled + t)))  # the sign is open
    angles = [rotation_angle(np.asarray(candidate) @ R.T) for candidate in rotations]
    return PoseError(
        rotation=min(angles),
        translation_angle=float(np.degrees(np.arccos(min(cosine, 1.0)))),
        translation=apart * metres_per_unit,
    )


def rotation_angle(R: Matrix3) -> float:
    """Return the angle of a rotation matrix in degrees, 0 to 180, precise at both ends."""
    # SciPy's Rotation raises if a file's matrix is not a rotation.
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    # |skew| = 2 sin, trace = 1 + 2 cos. The arccosine alone loses half of the digits near 0.
    twice_sine = np.linalg.norm(skew)
    twice_cosine = np.trace(R) - 1
    return float(np.degrees(np.arctan2(twice_sine, twice_cosine)))


def pair_accuracy(error: PoseError) -> float:
    """Return the share of the ten threshold pairs that a pair's error meets.

    A scene's mAA is the mean over pairs. Source: evaluation page of the Image Matching Challenge
    2022.
    """
    meets = (error.rotation < ROTATION_THRESHOLDS) & (
        error.translation < TRANSLATION_THRESHOLDS
    )
    return float(np.mean(meets))


def pose_auc(errors: Sequence[PoseError], threshold: float) -> float:
    """Return the area under the recall curve of angular errors up to ``threshold`` degrees.

    It is normalised to 0..1. The curve is piecewise linear through the sorted points (error_i, i /
    n), as in SuperGlue's evaluation. NaN without pairs.
    """
    from scipy.integrate import trapezoid  # here: SciPy's modules take half a second

    if not errors:
        return float("nan")
    angles = np.sort([0.0, *(error.angle for error in errors)])
    recall = np.arange(len(angles)) / len(errors)
    # The curve ends at the threshold with the recall of the last error below it.
    last = int(np.searchsorted(angles, threshold))
    x = np.append(angles[:last], threshold)
    y = np.append(recall[:last], recall[last - 1])
    return float(trapezoid(y, x) / threshold)
