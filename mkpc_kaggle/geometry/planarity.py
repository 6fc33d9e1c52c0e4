"""A test of whether one homography explains the inliers of an F: a flat scene, or no parallax.

Then F is not determined: a family of F fits the same points. Its pose and focal lengths may be far
off although all matches are right (Hartley and Zisserman, Multiple View Geometry, 11.9).
"""

import cv2
import numpy as np

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import AGREEMENT_PX
from mkpc_kaggle.geometry.robust import DistinctMatches, homogeneous
from mkpc_kaggle.geometry.two_view import sampson

TRANSFER_PX = 2.0  # maximum error of a match that the homography explains
MIN_PLANE_SHARE = 0.9  # of the inliers, explained by one homography; more is flat
MIN_INLIERS = 15  # a homography fits any four of them
PLANE_ITERATIONS = 1000
CONFIDENCE = 0.999


def plane_share(F: Matrix3, matches: Matches) -> float:
    """Return the share of the matches that agree with F that one homography explains, too.

    Matches are in image pixels; duplicates count once. 0 for fewer than ``MIN_INLIERS`` matches.
    The same input gives the same number.
    """
    distinct = DistinctMatches.of(matches)
    distances = sampson(F, homogeneous(distinct.points0), homogeneous(distinct.points1))
    agrees = np.abs(distances) < AGREEMENT_PX
    points0 = distinct.points0[agrees]
    points1 = distinct.points1[agrees]
    if len(points0) < MIN_INLIERS:
        return 0.0
    try:
        H, _ = cv2.findHomography(
            points0,
            points1,
            cv2.USAC_MAGSAC,
            TRANSFER_PX,
            maxIters=PLANE_ITERATIONS,
            confidence=CONFIDENCE,
        )
    except cv2.error:  # points that are all the same but for rounding
        return 0.0
    if H is None or not np.isfinite(H).all():
        return 0.0
    with np.errstate(all="ignore"):  # a point may be mapped to infinity
        mapped = cv2.perspectiveTransform(points0[None], H)[0]
        return float(np.mean(np.hypot(*(mapped - points1).T) < TRANSFER_PX))
