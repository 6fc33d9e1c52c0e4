"""A reconstruction is adjusted once more, and an image's keypoints count as much as they are exact.

Photographs of many cameras differ in sharpness, size and distance, and so does the noise of their keypoints.
COLMAP takes all for equally exact, and then the worst images move the focal lengths of the others. The noise of
each image is estimated from its residuals, all is adjusted with residuals in units of it, and so on: the variance
components of a block of photographs (Foerstner 1979), by the median instead of the mean.

COLMAP has no weights. But its residuals are in pixels: an image whose camera and keypoints are given in pixels as
large as its noise has residuals in units of its noise.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

ROUNDS = 3
HUBER_SIGMAS = 3.0  # residuals beyond are taken for mismatches more and more
MIN_OBSERVATIONS = 30  # of a camera whose noise can be told; others have the median camera's
MIN_NOISE_PX = 0.02  # what is more exact is made up
MEDIAN_TO_SIGMA = 0.8493  # 1 / sqrt(2 ln 2): of the length of a residual to its standard deviation on an axis


def adjust_by_noise(found: Any, threads: int) -> None:
    """Adjust pycolmap's reconstruction ``found`` in its place: cameras, focal lengths and points.

    Images that share a camera have one noise. Where most images do, nothing is done: their focal length is known
    from all of them.
    """
    images = [found.images[number] for number in found.reg_image_ids()]
    cameras: dict[int, list[Any]] = {}
    for image in images:
        cameras.setdefault(image.camera_id, []).append(image)
    if len(cameras) <= len(images) / 2:
        return
    loss = {"loss_function_type": pycolmap.LossFunctionType.HUBER, "loss_function_scale": HUBER_SIGMAS}
    ceres = {**loss, "use_gpu": False, "solver_options": {"num_threads": threads, "function_tolerance": 1e-6}}
    options = pycolmap.BundleAdjustmentOptions({"print_summary": False, "ceres": ceres})
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    scaled = [ScaledCamera(taken) for taken in cameras.values()]
    for _ in range(ROUNDS):
        known = [camera.noise(found.points3D) for camera in scaled]
        usual = float(np.median([noise for noise in known if noise] or [1.0]))
        for camera, noise in zip(scaled, known, strict=True):
            camera.set_pixel(noise or usual)
        pycolmap.create_default_bundle_adjuster(options, config, found).solve()
    for camera in scaled:
        camera.set_pixel(1.0)
    found.update_point_3d_errors()


class ScaledCamera:
    """A camera of pycolmap's, and the registered ``images`` of it, whose ``pixel`` is so many of its own large."""

    def __init__(self, images: Sequence[Any]) -> None:
        self._images, self._camera, self.pixel = images, images[0].camera, 1.0
        self._centre = np.array(self._camera.params)[self._camera.principal_point_idxs()]
        self._keypoints: list[dict[int, NDArray[np.float64]]] = [
            {number: image.points2D[number].xy.copy() for number in image.get_observation_point2D_idxs()}
            for image in images
        ]

    def noise(self, points: Any) -> float:
        """The standard deviation of its keypoints on an axis, in its own pixels; 0 where few tell."""
        residuals = np.concatenate([self._residuals(image, points) for image in self._images])
        if len(residuals) < MIN_OBSERVATIONS:
            return 0.0
        return max(MIN_NOISE_PX, MEDIAN_TO_SIGMA * self.pixel * float(np.nanmedian(residuals)))

    def _residuals(self, image: Any, points: Any) -> NDArray[np.float64]:
        """How far an image's keypoints are from what they see, (K,) in the present pixels."""
        seen = image.get_observation_points2D()
        pose = image.cam_from_world().matrix()
        world = np.array([points[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
        projected = self._camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        keypoints = np.array([point.xy for point in seen]).reshape(-1, 2)
        return np.asarray(np.linalg.norm(projected - keypoints, axis=1))

    def set_pixel(self, pixel: float) -> None:
        """Give the camera and its images' keypoints in pixels so many times as large as its own."""
        camera, params = self._camera, np.array(self._camera.params)
        params[camera.focal_length_idxs()] *= self.pixel / pixel
        params[camera.principal_point_idxs()] = self._centre / pixel
        camera.params = params
        for image, keypoints in zip(self._images, self._keypoints, strict=True):
            for number, point in keypoints.items():
                image.points2D[number].xy = point / pixel
        self.pixel = pixel
