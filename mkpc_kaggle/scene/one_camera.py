"""Images that one camera took at one zoom, seen by the focal lengths that were found for them one by one.

A reconstruction that gives each image a focal length of its own trades it for the distance to what the image sees,
and an image with few points may get any. Where most images of one size agree on theirs, one camera took them, and
a second reconstruction can know it from its start.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.scene.batch import BatchImage
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.model import Model, PlacedImage


@dataclass(frozen=True)
class OneCamera:
    """``focal`` length in pixels, and the names of the ``images`` that the camera took."""

    focal: float
    images: frozenset[str]


OneCameras: TypeAlias = Mapping[Size, OneCamera]
"""By the size of their images."""


def one_cameras(images: Sequence[BatchImage], models: Iterable[Model], config: SceneConfig) -> OneCameras:
    """The camera of each size of which ``one_camera_images`` are placed, most of them with one focal length.

    More than half are to be within a share of ``one_camera`` of their median. The camera took all images of the
    size, placed or not, but those that see many points at another focal length: these were taken at another zoom.
    """
    placed: dict[str, PlacedImage] = {}
    for model in models:
        for image in model.images:
            placed.setdefault(image.name, image)
    found: dict[Size, OneCamera] = {}
    for size in {image.size for image in placed.values()}:
        alike = [image for image in placed.values() if image.size == size]
        focal = float(np.median([image.focal for image in alike]))
        near = [image for image in alike if abs(image.focal / focal - 1) < config.one_camera]
        if len(alike) >= config.one_camera_images and len(near) > len(alike) / 2:
            many = config.one_camera_weak * float(np.median([image.points for image in alike]))
            zoomed = {image.name for image in alike if image not in near and image.points >= many}
            names = {image.name for image in images if image.size == size}
            found[size] = OneCamera(focal, frozenset(names - zoomed))
    return found


def camera_of(known: OneCameras, name: str, size: Size) -> OneCamera | None:
    """The camera that took the image with others."""
    camera = known.get(size)
    return camera if camera and name in camera.images else None
