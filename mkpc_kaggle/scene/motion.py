"""Motion of the camera between images: a camera that only turns shows no depth.

The images of a pure rotation are related by the homography K1 R K0^-1, in any scene. Nothing
can be triangulated from them, so positions of cameras are invented. Sources: Hartley and Zisserman
2004, 8.4; Torr, Fitzgibbon and Zisserman 1999.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX, Matrix3, Points, Size
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.view_graph import MIN_MATCHES, BatchImage, ViewGraph

Matrices: TypeAlias = NDArray[np.float64]

MAX_TRANSFER_PX = 4.0  # of a match that a homography explains
MIN_SHARE = 0.9  # of an edge's matches that its homography explains
# Deviation of K1^-1 H K0 from a multiple of a rotation: the ratio of its singular values, minus 1.
# Cameras that turned, or moved by 1 % of the distance, have at most 0.014. A poster seen from several
# places has at least 0.22.
MAX_DEVIATION = 0.05
# Share of these edges in images of a camera that hardly moved. It is at most 0.02 in five scenes of
# photographs from different places.
MIN_EDGES = 0.5
# Tried focal lengths over the initial ones. A sideways step along a wall is close to a turn with a
# telephoto lens, so the range is that of usual errors of the initial values.
RATIOS = np.geomspace(0.5, 1.6, 40)


def hardly_moved(merged: MergedGraph) -> bool:
    """Return whether most verified edges of a graph are rotations of the camera."""
    rotations = []
    for number, edge in enumerate(merged.graph.edges):
        # Verified for several focal lengths, with nearly the same matches
        geometry = next(reversed(merged.geometries.get(number, {}).values()), None)
        if geometry is None or geometry.H is None or len(geometry.inlier_matches) < MIN_MATCHES:
            continue
        index = np.asarray(geometry.inlier_matches)
        # H is for COLMAP's pixels, whose (0, 0) is the corner of the first one.
        centre = np.float32(COLMAP_CENTRE_PX)
        points0 = merged.keypoints[edge.first][index[:, 0]] + centre
        points1 = merged.keypoints[edge.second][index[:, 1]] + centre
        ends = (merged.graph.images[edge.first], merged.graph.images[edge.second])
        K0, K1 = (_intrinsics(image, merged.graph) for image in ends)
        rotations.append(is_rotation(np.asarray(geometry.H), points0, points1, K0, K1))
    return bool(rotations) and float(np.mean(rotations)) >= MIN_EDGES


def is_rotation(H: Matrix3, points0: Points, points1: Points, K0: Matrices, K1: Matrices) -> bool:
    """Return whether the homography H explains most matches (N, 2), and is that of a rotation for
    one of the intrinsics (K, 3, 3) of both cameras. Pixels are COLMAP's.
    """
    if not np.isfinite(H).all():
        return False
    transferred = np.column_stack([points0, np.ones(len(points0))]) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):  # points at infinity
        errors = np.linalg.norm(transferred[:, :2] / transferred[:, 2:] - points1, axis=1)
    if np.mean(errors < MAX_TRANSFER_PX) < MIN_SHARE:
        return False
    singular = np.linalg.svd(np.linalg.inv(K1) @ H @ K0, compute_uv=False)
    return bool((singular[:, 0] < (1 + MAX_DEVIATION) * singular[:, 2]).any())


def _intrinsics(image: BatchImage, graph: ViewGraph) -> Matrices:
    """Return the intrinsics (K, 3, 3) of an image for the tried focal lengths."""
    known = graph.known.get(image.digest)
    focal = graph.start_focal(image) if known is None else known.focal
    return intrinsics(focal, image.size)


def intrinsics(focal: float, size: Size) -> Matrices:
    """Return the intrinsics (K, 3, 3) for focal lengths around this one."""
    K = np.tile(np.eye(3), (len(RATIOS), 1, 1))
    K[:, 0, 0] = RATIOS * focal
    K[:, 1, 1] = RATIOS * focal
    K[:, :2, 2] = size.width / 2, size.height / 2
    return K
