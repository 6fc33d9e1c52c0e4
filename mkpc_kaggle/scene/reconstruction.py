"""What a reconstruction gives: cameras of images and points, without the cameras that cannot be right."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.scene.view_graph import BatchImage

MIN_IMAGES = 3  # in a model
MIN_POINTS = 30  # seen by a registered image
FOCALS = Range(0.3, 5.0)  # plausible focal lengths, in long sides of the image


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with its camera in its model's world units; ``points`` is the number of points that it sees."""

    image: BatchImage
    camera: Camera
    points: int

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

    Models are in order of size, the largest first, and an image may be in several. ``rejections`` say what was
    left out of them, one sentence each. ``failure`` is empty, or says why there is no model.
    """

    names: tuple[str, ...]
    models: tuple[SfmModel, ...] = ()
    rejections: tuple[str, ...] = ()
    failure: str = ""

    @property
    def registered(self) -> int:
        """How many of its images have a camera."""
        return len({found.image.name for model in self.models for found in model.images})

    @property
    def observations(self) -> int:
        """How often its images see points."""
        return sum(found.points for model in self.models for found in model.images)


def filter_models(models: Sequence[SfmModel]) -> tuple[tuple[SfmModel, ...], tuple[str, ...]]:
    """The models without the images that cannot be right, the largest first, and what was left out and why."""
    kept, rejections = [], []
    for model in models:
        reasons = [(found, rejection_reason(found)) for found in model.images]
        rejections += [f"image {found.image.name}: {reason}" for found, reason in reasons if reason]
        images = tuple(found for found, reason in reasons if not reason)
        if len(images) < MIN_IMAGES:
            rejections.append(f"a model of {len(images)} images is too small")
        else:
            kept.append(replace(model, images=images))
    return tuple(sorted(kept, key=lambda model: (-len(model.images), -len(model.points)))), tuple(rejections)


def rejection_reason(found: RegisteredImage) -> str:
    """Why an image's camera cannot be right, or an empty string."""
    camera = found.camera
    if not all(np.isfinite(part).all() for part in (camera.K, camera.R, camera.t)):
        return "its camera is not finite"
    relative_focal = found.focal / max(found.image.size)
    if relative_focal not in FOCALS:
        return f"its focal length is {relative_focal:.3g} long sides, outside of {FOCALS}"
    if found.points < MIN_POINTS:
        return f"it sees {found.points} points, fewer than {MIN_POINTS}"
    return ""
