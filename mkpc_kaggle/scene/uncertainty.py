"""Expected errors of a reconstruction's cameras, from their covariance.

All cameras together fix the origin, orientation and scale. So errors that a similarity of the world
explains do not count (the S-transformation of Baarda 1981).
"""

from collections.abc import Collection, Mapping
from math import inf
from statistics import median
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.two_view import cross_matrix
from mkpc_kaggle.scene.covariance import connected_part, covariance_of
from mkpc_kaggle.scene.models import SfmModel, Sigmas

# Standard deviation of a principal point from the middle of its image, as a share of the long side
PRINCIPAL_POINT_SHARE = 0.005


def centre_sigma_of_part(model: SfmModel) -> float:
    """Return the median sigma of the centres of a connected part of a large model, in sizes of the part;
    infinite if its points do not determine them.
    """
    sigmas = camera_sigmas(model.colmap, numbers=connected_part(model.colmap))
    return median(each.centre for each in sigmas.values()) if sigmas else inf


def camera_sigmas(
    model: Any,
    given_cameras: Mapping[str, KnownCamera] = MappingProxyType({}),
    numbers: Collection[int] | None = None,
) -> dict[str, Sigmas]:
    """Return the sigmas of registered images in pycolmap's reconstruction, by name; empty if
    unknown.

    ``given_cameras`` are the user's cameras by image name: exact ones, and priors that add to the
    images' information. With ``numbers``, the reconstruction is one of these images alone.
    """
    found = covariance_of(model, given_cameras, PRINCIPAL_POINT_SHARE, numbers)
    if found is None:
        return {}
    images = found.images
    focals = [found.focal_variance(image.camera) for image in images]
    variances = np.column_stack([_pose_variances(found.matrices, found.poses), focals])
    # Of a degenerate model
    if not np.isfinite(variances).all() or variances.min() < 0:
        return {}
    rows = np.sqrt(variances) * [np.degrees(1), 1, 100]
    for row, image in zip(rows, images, strict=True):
        if image.name in given_cameras and given_cameras[image.name].sigma:
            row[2] = combined(row[2], given_cameras[image.name].sigma)
    # Later digits vary between processors.
    sigmas = (Sigmas(*(float(f"{value:.4g}") for value in row)) for row in rows)
    return dict(zip((image.name for image in images), sigmas, strict=True))


def combined(sigma: float, prior: float) -> float:
    """Return the standard deviation of the weighted mean of two independent values with these
    deviations.
    """
    return float((sigma**-2 + prior**-2) ** -0.5) if sigma > 0 else 0.0


def _pose_variances(
    poses: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return variances (N, 2) of rotations, in radians, and centres, in model sizes; ``poses`` are
    [R | t] (N, 3, 4).
    """
    centres = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    size = np.sqrt(centres.var(axis=0).sum())
    if not size:  # cameras at one place, as of a panorama
        return np.full((len(poses), 2), np.inf)
    # Jacobians of angles and centres: by the parameters of each pose, and by a similarity of the world
    moves = []
    similarities = []
    zero = np.zeros((3, 4))  # neither the offset nor the scale of the world turns a camera
    placed = (centres - centres.mean(axis=0)) / size
    for pose, centre in zip(poses, placed, strict=True):
        R = pose[:, :3]
        angles = np.eye(3, 6)
        centre_moves = -R.T @ np.hstack([cross_matrix(pose[:, 3]), np.eye(3)]) / size
        moves.append(np.vstack([angles, centre_moves]))
        turned = [-R, zero]
        shifted = [-cross_matrix(centre), np.eye(3), centre[:, None]]
        similarities.append(np.block([turned, shifted]))
    basis, _ = np.linalg.qr(np.vstack(similarities))
    change = block_diag(*moves)
    change -= basis @ (basis.T @ change)
    # The diagonal of change @ covariance @ change.T, without the rest of that matrix
    variances = ((change @ covariance) * change).sum(axis=1)
    # Three angles and three coordinates of each image
    return np.asarray(variances.reshape(-1, 2, 3).sum(axis=2))
