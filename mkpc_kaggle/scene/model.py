"""What a reconstruction gives: cameras of images and points of the world, or a reason why there are none."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """An image whose camera is known, in its model's world units; ``points`` is how many of them it sees."""

    name: str
    size: Size
    camera: Camera
    points: int

    @property
    def focal(self) -> float:
        """In pixels."""
        return float(self.camera.K[0, 0])

    @property
    def relative_focal(self) -> float:
        """In long sides of the image."""
        return self.focal / max(self.size)


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras in one world, and points in it, (P, 3) float64; ``reprojection_error`` is the mean in pixels."""

    images: tuple[PlacedImage, ...]
    points: NDArray[np.float64]
    reprojection_error: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A connected component of a batch: the names of its images, and the models that were made of them.

    Models are in order of size, the largest first, and an image may be in several. ``doubts`` say what was left
    out of them, one sentence each. ``failure`` is empty, or says why there is no model.
    """

    names: tuple[str, ...]
    models: tuple[Model, ...] = ()
    doubts: tuple[str, ...] = ()
    failure: str = ""

    @property
    def placed(self) -> int:
        """How many of its images have a camera."""
        return len({image.name for model in self.models for image in model.images})
