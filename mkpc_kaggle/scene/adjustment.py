"""The last bundle adjustment of pycolmap's models, with the intrinsics that the user knows.

The global mapper refines all focal lengths, without priors, and leaves out points that only two
images see. With these, cameras of tourists' photographs are more accurate. But no third image
reveals a wrong match, so uncertain points of two views are removed first.

Cameras that the user knows are held, and the rest is refined.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import pycolmap

from mkpc_kaggle.geometry.intrinsics import KnownCamera

# Limits for a point that two images see, close to COLMAP's incremental mapper's for any point (4 pixels,
# 1.5 degrees). The global mapper keeps errors of a hundredth of the focal length, about ten pixels.
MAX_TWO_VIEW_ERROR_PX = 4.0
MIN_TWO_VIEW_ANGLE_DEG = 2.0
FINAL_ADJUSTMENT_ITERATIONS = 100
CONVERGED = 1e-6  # relative change of the cost
MAX_FLAT_PX = 1.0  # of a lens that counts as a pinhole, anywhere in its image
# The same for the lens of a single image, in long sides: its few points invent lenses of 0.009 on
# tourists' photographs, which lose 0.028 mAA by them. A camera of more images is well determined.
MAX_FLAT_SHARE = 0.01
BORDER_STEPS = 9  # of the grid of pixels that are compared


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
    for image in given:
        model.cameras[image.camera_id].params = list(cameras[image.name].parameters)
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


def drop_flat_lenses(model: Any, given: Collection[str], *, is_adjusted: bool) -> None:
    """Replace lenses of pycolmap's model that move no pixel by more than ``MAX_FLAT_PX`` by pinholes.
    Cameras of the images ``given``, by name, stay.

    If an adjustment follows, the limit for the lens of a single image is ``MAX_FLAT_SHARE``.
    """
    counts = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    kept = {image.camera_id for image in model.images.values() if image.name in given}
    for number, camera in model.cameras.items():
        if number in kept or not camera.extra_params_idxs():
            continue
        params = np.array(camera.params)
        focals = params[camera.focal_length_idxs()]
        centre = params[camera.principal_point_idxs()]
        x = np.linspace(0, camera.width, BORDER_STEPS)
        y = np.linspace(0, camera.height, BORDER_STEPS)
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        rays = np.column_stack([(pixels - centre) / focals, np.ones(len(pixels))])
        moved = np.linalg.norm(np.array(camera.img_from_cam(rays)) - pixels, axis=1)
        side = max(camera.width, camera.height)
        is_alone = is_adjusted and counts[number] == 1
        limit = MAX_FLAT_SHARE * side if is_alone else MAX_FLAT_PX
        if moved.max() <= limit:  # false for NaN
            names = pycolmap.CameraModelId
            camera.model = names.SIMPLE_PINHOLE if len(focals) == 1 else names.PINHOLE
            camera.params = [*focals, *centre]


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
