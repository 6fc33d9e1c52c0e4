"""Results of a reconstruction: cameras and points, without implausible cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.scene.view_graph import BatchImage

DATABASE, MODELS = "database.db", "models"  # COLMAP's files of a batch
MIN_IMAGES = 3  # in a model
MIN_POINTS = 30  # seen by a plausible image
PLAUSIBLE_FOCALS = Range(0.3, 5.0)  # plausible focal lengths, in long sides of the image


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with its camera, in the model's world units; ``points`` is the number of visible
    points.
    """

    image: BatchImage
    camera: Camera
    points: int
    # COLMAP's model with all parameters, as in a table of intrinsics: K has no distortion.
    lens: KnownCamera | None = None

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return float(self.camera.K[0, 0])

    @property
    def has_distortion(self) -> bool:
        """Whether F of its camera does not fit the pixels."""
        return self.lens is not None and self.lens.has_distortion


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
    cleaned = [
        replace(model, images=tuple(filter(is_plausible, model.images))) for model in models
    ]
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
