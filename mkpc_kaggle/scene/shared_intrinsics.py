"""Images that one camera took at one zoom, recognised by the focal lengths that were found for each.

A reconstruction that gives each image its own focal length trades it for the distance to what the image sees, and
an image with few points may get any. If most images of one size agree on theirs, one camera took them, and a
second reconstruction can share its intrinsics from the start. Where that one camera took them is known, the first
does.
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

PRIOR_FOCAL = 1.1  # long sides of the image: the focal length that cameras start with where nothing is known
MIN_ALIKE = 5  # registered images of one size
ZOOM_POINTS = 0.5  # an image that disagrees but sees this share of the median image's points has another zoom

# By the digest of an image, the focal length in pixels of the camera that it shares with others of its size.
SharedIntrinsics: TypeAlias = Mapping[str, float]


def start_focal(image: BatchImage, config: SceneConfig) -> float:
    """The focal length in pixels that an image's camera starts with."""
    return image.focal if config.exif and image.focal else PRIOR_FOCAL * max(image.size)


def given_intrinsics(images: Sequence[BatchImage], config: SceneConfig) -> SharedIntrinsics:
    """The focal length that all images of one size start with together; nothing unless the recipe says so."""
    if config.cameras is not CameraSharing.FOLDER:
        return {}
    starts = {}
    for size in {image.size for image in images}:
        known = [image.focal for image in images if image.size == size and image.focal and config.exif]
        starts[size] = float(np.median(known)) if known else PRIOR_FOCAL * max(size)
    return {image.digest: starts[image.size] for image in images}


def shared_intrinsics(
    images: Sequence[BatchImage], models: Sequence[SfmModel], tolerance: float
) -> SharedIntrinsics:
    """The focal lengths that images of one size share, because more than half of the registered images agree.

    To agree is to be within a share of ``tolerance`` of their median. All images of the size share it, registered
    or not, except those that see many points at another focal length: they were taken at another zoom.
    """
    registered = {found.image.digest: found for model in reversed(models) for found in model.images}
    shared: dict[str, float] = {}
    for size in {found.image.size for found in registered.values()}:
        alike = [found for found in registered.values() if found.image.size == size]
        focal = float(np.median([found.focal for found in alike]))
        near = [found for found in alike if abs(found.focal / focal - 1) < tolerance]
        if len(alike) >= MIN_ALIKE and len(near) > len(alike) / 2:
            many = ZOOM_POINTS * float(np.median([found.points for found in alike]))
            zoomed = {found.image for found in alike if found not in near and found.points >= many}
            shared |= {image.digest: focal for image in images if image.size == size and image not in zoomed}
    return shared
