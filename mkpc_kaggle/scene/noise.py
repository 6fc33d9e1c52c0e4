"""A reconstruction is adjusted once more, and an image's keypoints count as much as they are exact.

Photographs of many cameras differ in sharpness, size and distance, and so does the noise of their keypoints.
COLMAP takes all for equally exact, and then the worst images move the focal lengths of the others. The noise of
each image is estimated from its residuals, all is adjusted with residuals in units of it, and so on: the variance
components of a block of photographs (Foerstner 1979), by the median instead of the mean.

COLMAP has no weights. But its residuals are in pixels: an image whose camera and keypoints are given in pixels as
large as its noise has residuals in units of its noise.
"""

from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

ROUNDS = 3
HUBER_SIGMAS = 3.0  # residuals beyond are taken for mismatches more and more
MIN_OBSERVATIONS = 30  # of an image whose noise can be told; others have the median image's
MIN_NOISE_PX = 0.02  # what is more exact is made up
MEDIAN_TO_SIGMA = 0.8493  # 1 / sqrt(2 ln 2): of the length of a residual to its standard deviation on an axis


def adjust_by_noise(found: Any, threads: int) -> None:
    """Adjust pycolmap's reconstruction ``found`` in its place: cameras, focal lengths and points.

    Nothing is done where images share a camera: its focal length is known from all of them, and it has one size of
    pixels alone.
    """
    images = [found.images[number] for number in found.reg_image_ids()]
    if len({image.camera_id for image in images}) < len(images):
        return
    loss = {"loss_function_type": pycolmap.LossFunctionType.HUBER, "loss_function_scale": HUBER_SIGMAS}
    ceres = {**loss, "use_gpu": False, "solver_options": {"num_threads": threads, "function_tolerance": 1e-6}}
    options = pycolmap.BundleAdjustmentOptions({"print_summary": False, "ceres": ceres})
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    scaled = [ScaledImage(image) for image in images]
    for _ in range(ROUNDS):
        known = [image.noise(found.points3D) for image in scaled]
        usual = float(np.median([noise for noise in known if noise] or [1.0]))
        for image, noise in zip(scaled, known, strict=True):
            image.set_pixel(noise or usual)
        pycolmap.create_default_bundle_adjuster(options, config, found).solve()
    for image in scaled:
        image.set_pixel(1.0)
    found.update_point_3d_errors()


class ScaledImage:
    """A registered image of pycolmap's whose ``pixel`` is so many of its own pixels large."""

    def __init__(self, image: Any) -> None:
        self._image, self._camera, self.pixel = image, image.camera, 1.0
        self._centre = np.array(self._camera.params)[self._camera.principal_point_idxs()]
        self._keypoints: dict[int, NDArray[np.float64]] = {
            number: image.points2D[number].xy.copy() for number in image.get_observation_point2D_idxs()
        }

    def noise(self, points: Any) -> float:
        """The standard deviation of its keypoints on an axis, in its own pixels; 0 where few tell."""
        seen = self._image.get_observation_points2D()
        if len(seen) < MIN_OBSERVATIONS:
            return 0.0
        pose = self._image.cam_from_world().matrix()
        world = np.array([points[point.point3D_id].xyz for point in seen])
        projected = self._camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        residuals = np.linalg.norm(projected - np.array([point.xy for point in seen]), axis=1) * self.pixel
        return max(MIN_NOISE_PX, MEDIAN_TO_SIGMA * float(np.nanmedian(residuals)))

    def set_pixel(self, pixel: float) -> None:
        """Give its camera and keypoints in pixels so many times as large as its own."""
        camera, params = self._camera, np.array(self._camera.params)
        params[camera.focal_length_idxs()] *= self.pixel / pixel
        params[camera.principal_point_idxs()] = self._centre / pixel
        camera.params = params
        for number, point in self._keypoints.items():
            self._image.points2D[number].xy = point / pixel
        self.pixel = pixel
