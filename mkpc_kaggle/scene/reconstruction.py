"""What a reconstruction gives: cameras of images and points, without the cameras that cannot be right."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.scene.view_graph import BatchImage

MIN_IMAGES = 3  # in a model
MIN_POINTS = 30  # seen by a registered image
FOCALS = Range(0.3, 5.0)  # plausible focal lengths, in long sides of the image


class Sigmas(NamedTuple):
    """Root mean square errors to expect of a camera, see :mod:`mkpc_kaggle.scene.uncertainty`."""

    rotation: float  # degrees
    centre: float  # in units of the model's size, the root mean square distance of its cameras from their mean
    focal: float  # percent


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with its camera in its model's world units; ``points`` is the number of points that it sees.

    ``sigmas`` are its :class:`Sigmas`, or empty where they are unknown.
    """

    image: BatchImage
    camera: Camera
    points: int
    sigmas: Sigmas | tuple[()] = ()

    @property
    def focal(self) -> float:
        """In pixels."""
        return float(self.camera.K[0, 0])


@dataclass(frozen=True, eq=False)
class SfmModel:
    """Cameras in one world, and points in it, (P, 3) float64; ``reprojection_error`` is the mean in pixels.

    ``colmap`` is pycolmap's own value of it, which cannot leave its process.
    """

    images: tuple[RegisteredImage, ...]
    points: NDArray[np.float64]
    reprojection_error: float
    colmap: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "colmap": None}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A connected component of a batch: the names of its images, and the models that were made of them.

    Models are in order of size, the largest first, and an image may be in several. ``failure`` is empty, or says
    why there is no model.
    """

    names: tuple[str, ...]
    models: tuple[SfmModel, ...] = ()
    failure: str = ""

    @property
    def registered(self) -> int:
        """How many of its images have a camera."""
        return len({found.image.name for model in self.models for found in model.images})

    @property
    def observations(self) -> int:
        """How often its images see points."""
        return sum(found.points for model in self.models for found in model.images)


def filter_models(models: Sequence[SfmModel]) -> tuple[SfmModel, ...]:
    """The models without the images whose cameras cannot be right, if enough are left; the largest first."""
    cleaned = [replace(model, images=tuple(filter(is_plausible, model.images))) for model in models]
    kept = [model for model in cleaned if len(model.images) >= MIN_IMAGES]
    return tuple(sorted(kept, key=lambda model: (-len(model.images), -len(model.points))))


def is_plausible(found: RegisteredImage) -> bool:
    camera = found.camera
    is_finite = all(np.isfinite(part).all() for part in (camera.K, camera.R, camera.t))
    return is_finite and found.focal / max(found.image.size) in FOCALS and found.points >= MIN_POINTS
