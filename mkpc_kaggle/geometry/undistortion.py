"""Pictures without the distortion of their lens."""

import cv2
import numpy as np

from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX, Pixels, Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera


def undistorted(pixels: Pixels, lens: KnownCamera, pinhole: KnownCamera, size: Size) -> Pixels:
    """Return the picture of ``size`` that a pinhole takes in place of the lens of ``pixels``
    (H, W, 3). Pixels that the lens does not show are black.
    """
    K, distortion = opencv_camera(lens)
    target, _ = opencv_camera(pinhole)
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), target, size, cv2.CV_32FC1)
    # OpenCV's types do not say that the pixels are bytes.
    return np.asarray(cv2.remap(pixels, *maps, cv2.INTER_LINEAR), np.uint8)


def opencv_camera(camera: KnownCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return K (3, 3), with (0, 0) the centre of the first pixel, and OpenCV's coefficients: k1, k2,
    p1, p2, k3 to k6.
    """
    x, y = camera.principal_point
    focals = camera.focals
    K = np.array(
        [[focals[0], 0, x - COLMAP_CENTRE_PX], [0, focals[-1], y - COLMAP_CENTRE_PX], [0, 0, 1.0]]
    )
    coefficients = np.zeros(8)
    # COLMAP's models are parts of OpenCV's.
    coefficients[: len(camera.distortion)] = camera.distortion
    return K, coefficients
