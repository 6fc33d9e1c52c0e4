"""Comparison of a model's assumptions with its photographs: given focal lengths, and lenses without
distortion.

Bundle adjustment makes the best of a wrong assumption: reprojection errors stay small, since matches
were verified under the same assumption, and the poses are wrong. So a copy of the finished model is
adjusted with all focal lengths free, and with one radial coefficient for each pinhole. If these move
clearly, the photographs contradict the assumption. The model itself does not change. The copy starts
close to its optimum, so it takes a small part of the time of the model.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from math import log
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera, displacement_of
from mkpc_kaggle.scene.adjustment import robust_options
from mkpc_kaggle.scene.covariance import Covariance, covariance_of
from mkpc_kaggle.scene.models import (
    MAX_SIGMA_IMAGES,
    MIN_DISPLACEMENT,
    MIN_POINTS,
    Comparison,
    DistortedLens,
    DistortionContradiction,
    FocalContradiction,
    FocalSource,
    RegisteredImage,
    SfmModel,
    lens_of,
)

COLMAP_PINHOLES = (pycolmap.CameraModelId.SIMPLE_PINHOLE, pycolmap.CameraModelId.PINHOLE)
MAX_ASPECT_RATIO = 1.02  # of two focal lengths; a radial coefficient needs a common one
# Relative deviations of a focal length. Calibrations are better than 5 %. EXIF's values are rounded
# and ignore the distance of focus.
MAX_DEVIATION = 0.05
MAX_EXIF_DEVIATION = 0.3
# Of fx / fy, which photographs determine better than their mean. Pixels are square to 0.01.
MAX_RATIO_DEVIATION = 0.02
# Of images that share one. Images of one camera differ by up to 0.006 (three scenes at full size).
MAX_SHARED_DEVIATION = 0.05
MAX_STRAY_DEVIATION = 0.15  # of a single image, which may be a weak one
MAX_PRIOR_SIGMAS = 3.0  # of a prior
MIN_LENS_IMAGES = 3  # of one size; a single weak camera fits any coefficient
MIN_AGREEING = 0.8  # share of these images with at least half of the median displacement
MAX_IMAGE_POINTS = 300  # per image, of the longest tracks; more cost time and change nothing
CLEAR_SIGMAS = 5.0  # smaller differences are noise
LENS_SIGMA = 5.0  # percent, of the focal length in the row to give


class Freed(NamedTuple):
    """A registered image with its camera of the copy, as pycolmap has it, and as a lens."""

    registered: RegisteredImage
    camera: Any
    lens: KnownCamera
    is_radial: bool  # a pinhole with a free radial coefficient

    @property
    def focal(self) -> float:
        return self.lens.focal

    @property
    def displacement(self) -> float:
        """The displacement as in :class:`DistortedLens`."""
        return displacement_of(self.lens, self.registered.image.size)


class Noise:
    """Standard deviations of an adjusted copy's free parameters, from the covariance of its cameras."""

    def __init__(self, copy: Any) -> None:
        self._copy = copy

    def sigma(self, freed: Sequence[Freed], quantity: Callable[[KnownCamera], float]) -> float:
        """Return the median standard deviation of a quantity of the cameras; infinity if the model does
        not determine it.
        """
        # As for the model: time and memory would be too much. The many images have little noise.
        if self._copy.num_reg_images() > MAX_SIGMA_IMAGES:
            return 0.0
        if self._covariance is None:
            return float("inf")
        variances = [self._covariance.variance(each.camera, quantity) for each in freed]
        return float(np.sqrt(np.median(variances)))

    @cached_property
    def _covariance(self) -> Covariance | None:
        return covariance_of(self._copy, {}, 0.0)


def log_focal(camera: KnownCamera) -> float:
    return log(camera.focal)


def log_ratio(camera: KnownCamera) -> float:
    """Return the logarithm of fx / fy."""
    return log(camera.focals[0] / camera.focals[1])


def compare_with_photographs(
    model: SfmModel, given_cameras: Mapping[str, KnownCamera]
) -> Comparison:
    """Return what the photographs of a model contradict. ``given_cameras`` are the user's cameras, by image
    name.
    """
    copy = pycolmap.Reconstruction(model.colmap)
    _thin(copy)
    radial = {number for number, camera in copy.cameras.items() if _free_radial(camera)}
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(copy.reg_image_ids()):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(robust_options(), config, copy)
    adjuster.solve()
    images = {image.name: image for image in copy.images.values()}
    freed = []
    for registered in model.images:
        camera = images[registered.image.name].camera
        lens = lens_of(camera)
        if lens is not None:
            freed.append(Freed(registered, camera, lens, camera.camera_id in radial))
    noise = Noise(copy)
    given = [*_given_focals(noise, freed, given_cameras)]
    # A wrong focal length bends a model as a lens does. So does a model that is not determined.
    wrong = {name for contradiction in given for name in contradiction.images}
    determined = [
        freed_image
        for freed_image in freed
        if freed_image.registered.image.name not in wrong
        and (freed_image.registered.sigmas or len(freed) > MAX_SIGMA_IMAGES)
    ]
    lenses = tuple(_lenses(noise, determined))
    # A distorted lens bends a model, too, and each image then fits another focal length.
    shared = () if lenses else tuple(_shared_focals(model))
    focals = (*given, *shared, *_exif_focals(determined, given_cameras))
    distortions = tuple(_given_distortions(noise, determined, given_cameras))
    return Comparison(focals, lenses, distortions)


def _thin(copy: Any) -> None:
    """Remove short tracks of images that have ``MAX_IMAGE_POINTS`` longer ones."""
    counts = dict.fromkeys(copy.reg_image_ids(), 0)
    if copy.num_points3D() <= MAX_IMAGE_POINTS:
        return
    lengths = {number: copy.points3D[number].track.length() for number in copy.point3D_ids()}
    # Of equally long tracks, the point with the lower number
    for number in sorted(lengths, key=lambda number: (-lengths[number], number)):
        images = {element.image_id for element in copy.points3D[number].track.elements}
        if all(counts[image] >= MAX_IMAGE_POINTS for image in images):
            copy.delete_point3D(number)
            continue
        for image in images:
            counts[image] += 1


def _free_radial(camera: Any) -> bool:
    """Give a pinhole a radial coefficient of 0. Return whether it has one now."""
    *focals, x, y = camera.params
    if camera.model not in COLMAP_PINHOLES or max(focals) > MAX_ASPECT_RATIO * min(focals):
        return False
    focal = camera.mean_focal_length()
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [focal, x, y, 0.0]
    return True


def _given_focals(
    noise: Noise, freed: Sequence[Freed], given_cameras: Mapping[str, KnownCamera]
) -> Iterable[FocalContradiction]:
    """Yield the user's cameras with a focal length that the photographs contradict."""
    for camera in dict.fromkeys(given_cameras.values()):
        alike = [
            freed_image
            for freed_image in freed
            if given_cameras.get(freed_image.registered.image.name) == camera
        ]
        if not alike:
            continue
        fitted = float(np.median([freed_image.focal for freed_image in alike]))
        limit = np.log1p(max(MAX_DEVIATION, MAX_PRIOR_SIGMAS * camera.sigma / 100))
        deviation = abs(np.log(fitted / camera.focal))
        names = tuple(freed_image.registered.image.name for freed_image in alike)
        found = FocalContradiction(FocalSource.INTRINSICS, names, camera.focal, fitted)
        axes = _fitted_axes(alike, camera)
        if axes and _contradicts_ratio(noise, alike, camera, axes):
            yield replace(found, given_axes=camera.focals, fitted_axes=axes)
        elif deviation > limit and deviation > CLEAR_SIGMAS * noise.sigma(alike, log_focal):
            yield found
        else:
            yield from _stray_focals(noise, alike, camera, limit)


def _stray_focals(
    noise: Noise, alike: Sequence[Freed], camera: KnownCamera, limit: float
) -> Iterable[FocalContradiction]:
    """Yield the images of a row that its focal length does not fit, though it fits the others: they
    were taken with another zoom.
    """
    limit = max(limit, np.log1p(MAX_STRAY_DEVIATION))
    far = [each for each in alike if abs(np.log(each.focal / camera.focal)) > limit]
    clear = CLEAR_SIGMAS * noise.sigma(far, log_focal) if far else 0.0
    stray = [each for each in far if abs(np.log(each.focal / camera.focal)) > clear]
    if stray:
        names = tuple(each.registered.image.name for each in stray)
        fitted = float(np.median([each.focal for each in stray]))
        yield FocalContradiction(FocalSource.INTRINSICS, names, camera.focal, fitted)


def _fitted_axes(alike: Sequence[Freed], camera: KnownCamera) -> tuple[float, ...]:
    """Return the medians of fx and fy of copies that have both free; empty for a single focal length."""
    # Pinholes whose pixels are almost square have one in the copy, see _free_radial.
    if len(camera.focals) == 1 or any(freed_image.is_radial for freed_image in alike):
        return ()
    axes = np.median([freed_image.lens.focals for freed_image in alike], axis=0)
    return float(axes[0]), float(axes[1])


def _contradicts_ratio(
    noise: Noise, alike: Sequence[Freed], camera: KnownCamera, axes: Sequence[float]
) -> bool:
    """Return whether the photographs contradict fx / fy of a camera; ``axes`` are the fitted ones."""
    deviation = abs(log(axes[0] / axes[1]) - log_ratio(camera))
    if deviation <= np.log1p(MAX_RATIO_DEVIATION):
        return False
    # Both focal lengths err together, so their ratio is known much better than each.
    return deviation > CLEAR_SIGMAS * noise.sigma(alike, log_ratio)


def _given_distortions(
    noise: Noise, freed: Sequence[Freed], given_cameras: Mapping[str, KnownCamera]
) -> Iterable[DistortionContradiction]:
    """Yield the user's cameras with a distortion that the photographs contradict."""
    for camera in dict.fromkeys(given_cameras.values()):
        if not any(camera.distortion):
            continue
        alike = [each for each in freed if given_cameras.get(each.registered.image.name) == camera]
        if len(alike) < MIN_LENS_IMAGES:
            continue
        size = alike[0].registered.image.size
        given = displacement_of(camera, size)
        changes = [each.displacement - given for each in alike]
        change = float(np.median(changes))
        agreeing = sum(each / change > 0.5 for each in changes) if change else 0
        sigma = noise.sigma(alike, partial(displacement_of, size=size))
        is_clear = abs(change) >= max(MIN_DISPLACEMENT, CLEAR_SIGMAS * sigma)
        if is_clear and agreeing >= MIN_AGREEING * len(alike):
            parameters = np.median([each.lens.parameters for each in alike], axis=0)
            fitted = replace(camera, parameters=tuple(parameters.tolist()))
            names = tuple(each.registered.image.name for each in alike)
            yield DistortionContradiction(names, given, given + change, fitted)


def sharing_images(colmap: Any) -> dict[int, list[str]]:
    """Return the names of the images that share a camera, by the camera's number."""
    names: dict[int, list[str]] = {}
    for number in sorted(colmap.reg_image_ids()):
        image = colmap.images[number]
        names.setdefault(image.camera_id, []).append(image.name)
    return {camera: found for camera, found in names.items() if len(found) > 1}


def _shared_focals(model: SfmModel) -> Iterable[FocalContradiction]:
    """Yield the focal lengths that images share, but that some of these contradict.

    Each image alone is registered to the points of the model with its own focal length.
    """
    groups = sharing_images(model.colmap)
    if not groups:
        return
    images = {image.name: image for image in model.colmap.images.values()}
    for names in groups.values():
        given = float(images[names[0]].camera.mean_focal_length())
        fitted = {name: own_focal(model.colmap, images[name]) for name in names}
        limit = np.log1p(MAX_SHARED_DEVIATION)
        wrong = [name for name in names if abs(np.log(fitted[name] / given)) > limit]
        if wrong:
            median = float(np.median([fitted[name] for name in wrong]))
            yield FocalContradiction(FocalSource.SHARED, tuple(wrong), given, median)


def own_focal(colmap: Any, image: Any) -> float:
    """Return the focal length with which an image alone fits the points of a model best; the image's own
    if that is not determined.
    """
    focal = float(image.camera.mean_focal_length())
    seen = [point for point in image.points2D if point.has_point3D()]
    # Evenly spread over the keypoints; more take time and change nothing.
    seen = seen[:: max(1, len(seen) // MAX_IMAGE_POINTS)]
    if len(seen) < MIN_POINTS:
        return focal
    points2D = np.array([point.xy for point in seen])
    points3D = np.array([colmap.points3D[point.point3D_id].xyz for point in seen])
    camera = pycolmap.Camera(image.camera.todict())
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length = True
    refined = pycolmap.refine_absolute_pose(
        image.cam_from_world(), points2D, points3D, np.ones(len(seen), bool), camera, options
    )
    return float(camera.mean_focal_length()) if refined is not None else focal


def _exif_focals(
    freed: Sequence[Freed], given_cameras: Mapping[str, KnownCamera]
) -> Iterable[FocalContradiction]:
    """Yield the images whose refined focal lengths are far from EXIF's."""
    wrong = []
    for freed_image in freed:
        image = freed_image.registered.image
        # The user's cameras replace EXIF's.
        if not image.focal or image.name in given_cameras:
            continue
        deviation = abs(np.log(freed_image.registered.focal / image.focal))
        sigma = freed_image.registered.sigmas.focal / 100 if freed_image.registered.sigmas else 0.0
        if deviation > np.log1p(MAX_EXIF_DEVIATION) and deviation > CLEAR_SIGMAS * sigma:
            wrong.append(freed_image.registered)
    if wrong:
        given = float(np.median([registered.image.focal for registered in wrong]))
        fitted = float(np.median([registered.focal for registered in wrong]))
        names = tuple(registered.image.name for registered in wrong)
        yield FocalContradiction(FocalSource.EXIF, names, given, fitted)


def _lenses(noise: Noise, freed: Sequence[Freed]) -> Iterable[DistortedLens]:
    """Yield the lenses of a model's pinholes that are clearly distorted; images of one size share
    a lens.
    """
    pinholes = [each for each in freed if each.is_radial]
    for size in dict.fromkeys(each.registered.image.size for each in pinholes):
        alike = [each for each in pinholes if each.registered.image.size == size]
        displacement = float(np.median([each.displacement for each in alike]))
        if len(alike) < MIN_LENS_IMAGES or not abs(displacement) >= MIN_DISPLACEMENT:
            continue
        agreeing = sum(each.displacement / displacement > 0.5 for each in alike)
        if agreeing < MIN_AGREEING * len(alike):
            continue
        if abs(displacement) < CLEAR_SIGMAS * noise.sigma(
            alike, partial(displacement_of, size=size)
        ):
            continue
        coefficient = float(np.median([each.lens.distortion[0] for each in alike]))
        focal = float(np.median([each.focal for each in alike]))
        parameters = (focal, size.width / 2, size.height / 2, coefficient)
        camera = KnownCamera("SIMPLE_RADIAL", parameters, LENS_SIGMA)
        names = tuple(each.registered.image.name for each in alike)
        yield DistortedLens(names, displacement, camera)


def adopted_lenses_of(
    model: SfmModel, lenses: Mapping[str, KnownCamera]
) -> Iterable[DistortedLens]:
    """Yield the lenses of a model whose images have started with ``lenses``, by digest: the medians
    of each size.
    """
    groups: dict[tuple[Size, str], list[RegisteredImage]] = {}
    for found in model.images:
        if found.image.digest in lenses and found.lens is not None:
            groups.setdefault((found.image.size, found.lens.model), []).append(found)
    for (size, name), alike in groups.items():
        parameters = np.median([found.lens.parameters for found in alike if found.lens], axis=0)
        camera = KnownCamera(name, tuple(parameters.tolist()), LENS_SIGMA)
        names = tuple(found.image.name for found in alike)
        yield DistortedLens(names, displacement_of(camera, size), camera, True)
