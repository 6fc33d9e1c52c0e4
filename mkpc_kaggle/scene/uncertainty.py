"""Uncertainty of a reconstruction's cameras, from the covariance of bundle adjustment.

All cameras together fix the origin, orientation and scale. So errors that a similarity of the world
explains do not count (the S-transformation of Baarda 1981). The noise of keypoints is estimated
from the residuals.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.linalg import block_diag

from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.two_view import cross_matrix
from mkpc_kaggle.scene.models import MAX_SIGMA_IMAGES, Sigmas

# The world is free, so the normal equations are singular
DAMPED = pycolmap.BACovarianceOptions({"damping": 1e-3})


def camera_sigmas(
    model: Any, given_cameras: Mapping[str, KnownCamera] = MappingProxyType({})
) -> dict[str, Sigmas]:
    """Return the sigmas of registered images in pycolmap's reconstruction, by name; empty if
    unknown.

    ``given_cameras`` are the user's cameras by image name: exact ones, and priors that add to the
    images' information.
    """
    images = [
        image for _, image in sorted(model.images.items()) if image.has_pose and image.num_points3D
    ]
    if not 1 < len(images) <= MAX_SIGMA_IMAGES:
        return {}
    ids = [image.image_id for image in images]
    adjuster = evaluator(model, images, given_cameras)
    fit = adjuster.solve().ceres_summary
    redundancy = fit.num_residuals - fit.num_effective_parameters + 7
    solved: Any = redundancy > 0 and pycolmap.estimate_ba_covariance(DAMPED, model, adjuster)
    if not solved:
        return {}
    poses = np.block([[solved.get_cam_cross_cov_from_world(i, j) for j in ids] for i in ids])
    if not np.isfinite(poses).all():  # of a degenerate model
        return {}
    focals = [
        _focal_variance(image.camera, given_cameras.get(image.name), solved) for image in images
    ]
    variances = _pose_variances([image.cam_from_world().matrix() for image in images], poses)
    noise = 2 * fit.initial_cost / redundancy  # variance of a keypoint's coordinate, square pixels
    sigmas = np.sqrt(noise * np.column_stack([variances, focals])) * [np.degrees(1), 1, 100]
    for row, image in zip(sigmas, images, strict=True):
        if image.name in given_cameras and given_cameras[image.name].sigma:
            row[2] = combined(row[2], given_cameras[image.name].sigma)
    # Later digits vary between calls
    rows = (Sigmas(*(float(f"{value:.4g}") for value in row)) for row in sigmas)
    return dict(zip((image.name for image in images), rows, strict=True))


def evaluator(model: Any, images: Sequence[Any], given_cameras: Mapping[str, KnownCamera]) -> Any:
    """Return a bundle adjustment of the images that evaluates the model and leaves it as it is."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
        # The user's exact cameras are no parameters.
        if image.name in given_cameras and not given_cameras[image.name].sigma:
            config.set_constant_cam_intrinsics(image.camera_id)
    # No iterations: the solver only evaluates the residuals.
    solver = {"max_num_iterations": 0, "num_threads": 1}
    ceres = {"use_gpu": False, "solver_options": solver}
    options = pycolmap.BundleAdjustmentOptions({"print_summary": False, "ceres": ceres})
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _focal_variance(camera: Any, known: KnownCamera | None, solved: Any) -> float:
    """Return the variance of the logarithm of a focal length, for keypoints of unit noise."""
    # An exact camera is no parameter, so it has no covariance.
    if known is not None and not known.sigma:
        return 0.0
    variance = solved.get_other_params_cov(camera.params)[0, 0]
    return float(variance / camera.mean_focal_length() ** 2)


def combined(sigma: float, prior: float) -> float:
    """Return the standard deviation of the weighted mean of two independent values with these
    deviations.
    """
    return float((sigma**-2 + prior**-2) ** -0.5) if sigma > 0 else 0.0


def _pose_variances(
    poses: list[NDArray[np.float64]], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return variances (N, 2) of rotations, in radians, and centres, in model sizes; ``poses`` are
    [R | t].
    """
    centres = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    size = np.sqrt(centres.var(axis=0).sum())
    # Jacobians of angles and centres: by the parameters of each pose, and by a similarity of the world
    moves = []
    similarities = []
    zero = np.zeros((3, 4))  # neither the offset nor the scale of the world turns a camera
    placed = (centres - centres.mean(axis=0)) / size
    for pose, centre in zip(poses, placed, strict=True):
        # COLMAP's parameters are half angles and t
        R = pose[:, :3]
        t = pose[:, 3]
        angles = 2 * np.eye(3, 6)
        centre_moves = -R.T @ np.hstack([2 * cross_matrix(t), np.eye(3)]) / size
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
