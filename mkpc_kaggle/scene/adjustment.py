"""The last bundle adjustment of pycolmap's models, with the intrinsics that the user knows.

The global mapper refines all focal lengths, without priors, and leaves out points that only two
images see. With these, cameras of tourists' photographs are more accurate. But no third image
reveals a wrong match, so uncertain points of two views are removed first.

A prior is the mean of the mapper's focal length and the user's, weighted by their variances, as if
bundle adjustment had one more measurement. These cameras are then held, and the rest is refined.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pycolmap

from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.scene.uncertainty import camera_sigmas

# Limits for a point that two images see, close to COLMAP's incremental mapper's for any point (4 pixels,
# 1.5 degrees). The global mapper keeps errors of a hundredth of the focal length, about ten pixels.
MAX_TWO_VIEW_ERROR_PX = 4.0
MIN_TWO_VIEW_ANGLE_DEG = 2.0
FINAL_ADJUSTMENT_ITERATIONS = 100
CONVERGED = 1e-6  # relative change of the cost


def adjust(model: Any, cameras: Mapping[str, KnownCamera]) -> None:
    """Set the cameras that the user knows in pycolmap's model; refine poses, points and other cameras
    by all tracks.

    ``cameras`` is by image name; each of these images has its own camera.
    """
    remove_uncertain_points(model)
    given = [
        image
        for _, image in sorted(model.images.items())
        if image.has_pose and image.name in cameras
    ]
    # Computed without the user's knowledge, so that the two can be weighed
    sigmas = camera_sigmas(model) if given else {}
    for image in given:
        # Bundle adjustment does not determine this focal length: the user's counts alone.
        sigma = sigmas[image.name].focal if image.name in sigmas else np.inf
        set_camera(model.cameras[image.camera_id], cameras[image.name], sigma)
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.reg_image_ids()):
        config.add_image(number)
    for image in given:
        config.set_constant_cam_intrinsics(image.camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = robust_options()
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    model.update_point_3d_errors()


def robust_options() -> Any:
    """Return the options of a bundle adjustment of a finished model."""
    # With more threads, the last digits vary
    solver = {
        "max_num_iterations": FINAL_ADJUSTMENT_ITERATIONS,
        "num_threads": 1,
        "function_tolerance": CONVERGED,
    }
    ceres = {
        "use_gpu": False,
        # A few wrong tracks remain in any model.
        "loss_function_type": "HUBER",
        "loss_function_scale": 1.0,
        "solver_options": solver,
    }
    return pycolmap.BundleAdjustmentOptions({"print_summary": False, "ceres": ceres})


def remove_uncertain_points(found: Any) -> None:
    """Remove points of two views with large errors, or with nearly parallel rays, from pycolmap's
    model.
    """
    observations = pycolmap.ObservationManager(found)
    observations.filter_points3D_with_large_reprojection_error(
        MAX_TWO_VIEW_ERROR_PX, two_view_points(found)
    )
    observations.filter_points3D_with_small_triangulation_angle(
        MIN_TWO_VIEW_ANGLE_DEG, two_view_points(found)
    )


def two_view_points(found: Any) -> set[int]:
    """Return the numbers of the points of pycolmap's model that two images see."""
    return {number for number, point in found.points3D.items() if point.track.length() == 2}


def set_camera(camera: Any, known: KnownCamera, sigma: float) -> None:
    """Set a camera's parameters; ``sigma`` is the deviation of its present focal length in percent."""
    if not known.sigma:
        camera.params = list(known.parameters)
        return
    # Of the user's value; in logarithms, where a deviation in percent has no direction
    weight = sigma**2 / (sigma**2 + known.sigma**2) if np.isfinite(sigma) else 1.0
    focal = np.exp((1 - weight) * np.log(camera.mean_focal_length()) + weight * np.log(known.focal))
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] *= focal / camera.mean_focal_length()
    camera.params = params.tolist()
