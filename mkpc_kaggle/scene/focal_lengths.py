"""Intrinsics of the user in pycolmap's models: exact ones restored, uncertain ones as priors.

The global mapper refines all focal lengths, without priors. A prior joins afterwards: the mean of
the mapper's focal length and the user's, weighted by their variances, as if bundle adjustment had
one more measurement. A last bundle adjustment then holds these cameras and refines the rest.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pycolmap

from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.scene.uncertainty import camera_sigmas

MAX_ITERATIONS = 100


def apply_known_cameras(found: Any, known: Mapping[str, KnownCamera]) -> None:
    """Set the cameras that the user knows in pycolmap's model, and refine poses, points and other
    cameras.

    ``known`` is by image name; each of these images has its own camera. If it is empty, the model stays as it is.
    """
    placed = [
        image for _, image in sorted(found.images.items()) if image.has_pose and image.name in known
    ]
    if not placed:
        return
    # Computed without the user's knowledge, so that the two can be weighed
    sigmas = camera_sigmas(found)
    for image in placed:
        # Bundle adjustment does not determine this focal length: the user's counts alone.
        sigma = sigmas[image.name].focal if image.name in sigmas else np.inf
        set_camera(found.cameras[image.camera_id], known[image.name], sigma)
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(found.reg_image_ids()):
        config.add_image(number)
    for image in placed:
        config.set_constant_cam_intrinsics(image.camera_id)
    # With more, the last digits vary
    solver = {"max_num_iterations": MAX_ITERATIONS, "num_threads": 1}
    ceres = {
        "use_gpu": False,
        # A few wrong tracks remain in any model.
        "loss_function_type": "HUBER",
        "loss_function_scale": 1.0,
        "solver_options": solver,
    }
    options = pycolmap.BundleAdjustmentOptions({"print_summary": False, "ceres": ceres})
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, found)
    adjuster.solve()
    found.update_point_3d_errors()


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
