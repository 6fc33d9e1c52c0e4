"""Results of a reconstruction: cameras and points, without implausible cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.scene.view_graph import BatchImage

MIN_IMAGES = 3  # in a model
MIN_POINTS = 30  # seen by a plausible image
MAX_POINTS = 20_000  # of a model, for pictures and views: the points of the longest tracks
MAX_SIGMA_IMAGES = 200  # of a model with sigmas; memory is quadratic and time cubic in the images
# Sigma of centres, in sizes of the model. Over draws of five scenes (benchmarks.candidates), cameras
# with a sigma up to 0.1 gain 0.08 to 0.11 on F of the pair. The others gain 0.01.
LOOSE_SIGMA = 0.25
# Of the model's size; a camera with a larger expected error is uncertain. Half of the tourists'
# photographs of reichstag_26 are above 0.02, and their errors are 0.013.
MAX_CENTRE_SIGMA = 0.05
# Of a clearly distorted lens, see DistortedLens. The largest of five scenes of undistorted photographs
# is 0.0014; k = -0.05 of a phone is 0.015.
MIN_DISPLACEMENT = 0.005
# The reason for missing and for doubtful cameras
HARDLY_MOVED = (
    "the camera hardly moved: nothing can be triangulated; step aside between photographs"
)
PLAUSIBLE_FOCALS = Range(0.3, 5.0)  # plausible focal lengths, in long sides of the image


class Sigmas(NamedTuple):
    """Expected root mean square errors of a camera; see :mod:`mkpc_kaggle.scene.uncertainty`."""

    rotation: float  # degrees
    centre: float  # over the model's size, the RMS distance of its cameras from their mean
    focal: float  # percent


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with its camera, in the model's world units; ``points`` is the number of visible
    points.

    ``sigmas`` is empty if unknown: the points do not determine the camera, or the model has more
    than ``MAX_SIGMA_IMAGES`` images.
    """

    image: BatchImage
    camera: Camera
    points: int
    sigmas: Sigmas | tuple[()] = ()
    # COLMAP's model with all parameters, as in a table of intrinsics: K has no distortion.
    lens: KnownCamera | None = None

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return float(self.camera.K[0, 0])

    @property
    def has_distortion(self) -> bool:
        """Whether F of its camera does not fit the pixels."""
        return self.lens is not None and any(self.lens.distortion)


class FocalSource(StrEnum):
    """Origin of a focal length that was given."""

    INTRINSICS = "--intrinsics"
    EXIF = "EXIF"
    SHARED = "shared"  # with other images, as with --camera folder


@dataclass(frozen=True)
class FocalContradiction:
    """A given focal length that the photographs contradict; both are medians over the images, in
    pixels.

    If they contradict the ratio of fx and fy, ``given_axes`` and ``fitted_axes`` have both of each.
    """

    source: FocalSource
    images: tuple[str, ...]
    given: float
    fitted: float
    given_axes: tuple[float, ...] = ()
    fitted_axes: tuple[float, ...] = ()


@dataclass(frozen=True)
class DistortedLens:
    """A lens with radial distortion, which pinholes do not fit.

    ``displacement`` is that of a point half the long side away from the middle, as a share of this
    distance; negative for a barrel. ``camera`` has the model and the parameters that fit, as in a
    table of intrinsics. ``is_adopted`` if the model has this lens.
    """

    images: tuple[str, ...]
    displacement: float
    camera: KnownCamera
    is_adopted: bool = False


@dataclass(frozen=True)
class DistortionContradiction:
    """A distortion of the user's that the photographs contradict; displacements as in
    :class:`DistortedLens`. ``camera`` has the parameters that fit.
    """

    images: tuple[str, ...]
    given: float
    fitted: float
    camera: KnownCamera


@dataclass(frozen=True)
class Comparison:
    """Assumptions that the photographs of a model contradict; see :mod:`mkpc_kaggle.scene.comparison`."""

    focals: tuple[FocalContradiction, ...] = ()
    lenses: tuple[DistortedLens, ...] = ()
    distortions: tuple[DistortionContradiction, ...] = ()
    has_moved: bool = True  # False: the camera only turned, see :mod:`mkpc_kaggle.scene.motion`


@dataclass(frozen=True, eq=False)
class SfmModel:
    """Cameras and points (P, 3) float64 in one world frame; ``reprojection_error`` is the mean in
    pixels.

    The points of the longest tracks come first. ``colmap`` is pycolmap's model, which is not
    pickled.
    """

    images: tuple[RegisteredImage, ...]
    points: NDArray[np.float64]
    reprojection_error: float
    colmap: Any = None
    comparison: Comparison = Comparison()

    @property
    def centre_sigma(self) -> float | None:
        """The median sigma of the centres, in sizes of the model; infinite if the points do not
        determine them, ``None`` if unknown, as of more than ``MAX_SIGMA_IMAGES`` images.
        """
        if not self.images or len(self.images) > MAX_SIGMA_IMAGES:
            return None
        # Bundle adjustment does not determine a camera without sigmas.
        sigmas = [found.sigmas.centre if found.sigmas else np.inf for found in self.images]
        return float(np.median(sigmas))

    @property
    def is_loose(self) -> bool:
        """True if most cameras are unknown to within the model's own size, as far as sigmas are known.

        Parts of the model then hang together loosely, or wrong matches have bent it.
        """
        return self.centre_sigma is not None and self.centre_sigma > LOOSE_SIGMA

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "colmap": None}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result for a connected component of a batch: image names, and models, the largest first.

    An image may be in several models. ``failure`` is the reason for a component without models,
    else empty.
    """

    names: tuple[str, ...]
    models: tuple[SfmModel, ...] = ()
    failure: str = ""

    @property
    def registered(self) -> int:
        """Number of images with a camera."""
        return len({found.image.name for model in self.models for found in model.images})

    @property
    def observations(self) -> int:
        """Number of observations of points in images."""
        return sum(found.points for model in self.models for found in model.images)


def filter_models(models: Sequence[SfmModel]) -> tuple[SfmModel, ...]:
    """Remove implausible cameras, then models with too few images. Return the rest, the largest
    first.
    """
    cleaned = [replace(model, images=tuple(filter(is_plausible, model.images))) for model in models]
    kept = [model for model in cleaned if len(model.images) >= MIN_IMAGES]
    return tuple(sorted(kept, key=lambda model: (-len(model.images), -len(model.points))))


def is_plausible(found: RegisteredImage) -> bool:
    camera = found.camera
    is_finite = all(np.isfinite(part).all() for part in (camera.K, camera.R, camera.t))
    return (
        is_finite
        and found.focal / max(found.image.size) in PLAUSIBLE_FOCALS
        and found.points >= MIN_POINTS
    )


def lens_of(camera: Any) -> KnownCamera | None:
    """Return the model and parameters of pycolmap's camera; ``None`` if no lens has them."""
    try:
        return KnownCamera(camera.model_name, tuple(float(each) for each in camera.params))
    except ValueError:  # such as a focal length below zero, of an implausible image
        return None


def models_of(reconstructions: Sequence[Reconstruction]) -> tuple[SfmModel, ...]:
    """Return the models of all reconstructions, the largest first."""
    models = (model for found in reconstructions for model in found.models)
    return tuple(sorted(models, key=lambda model: -len(model.images)))
