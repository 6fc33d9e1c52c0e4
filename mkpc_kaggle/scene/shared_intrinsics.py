"""Shared intrinsics of images from one camera at one zoom, detected by their focal lengths.

An image's own focal length is ambiguous with the distance to the scene, and poorly constrained by
few points. If most images of one size agree on the focal length, one camera is assumed. A second
reconstruction then has shared intrinsics. If the user declares one camera, the first reconstruction
already has shared intrinsics.
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.focal_prior import FOCAL_RATIO
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

TOLERANCE = 0.02  # maximum relative deviation of agreeing focal lengths from the median
MIN_ALIKE = 5  # registered images of one size
# Share of the median number of points; an image with more that disagrees has another zoom
ZOOM_POINTS = 0.5

# By image digest: the focal length, in pixels, of the camera that images of one size share.
SharedIntrinsics: TypeAlias = Mapping[str, float]


def start_focal(image: BatchImage) -> float:
    """Return the initial focal length of an image's camera, in pixels; from EXIF if known."""
    return image.focal or FOCAL_RATIO * max(image.size)


def given_intrinsics(images: Sequence[BatchImage], config: SceneConfig) -> SharedIntrinsics:
    """Return one initial focal length for all images of a size, if the recipe shares cameras.

    The ``images`` are those whose intrinsics the user does not know, as in
    :func:`shared_intrinsics`.
    """
    if config.cameras is not CameraSharing.FOLDER:
        return {}
    starts = {}
    for size in {image.size for image in images}:
        known = [image.focal for image in images if image.size == size and image.focal]
        starts[size] = float(np.median(known)) if known else FOCAL_RATIO * max(size)
    return {image.digest: starts[image.size] for image in images}


def shared_intrinsics(images: Sequence[BatchImage], models: Sequence[SfmModel]) -> SharedIntrinsics:
    """Return, for each image size, the focal length on which more than half of the registered
    images agree.

    All images of the size, registered or not, share the median focal length. Exceptions are images
    that see many points at another focal length, since they have another zoom.
    """
    free = {image.digest for image in images}
    placed = (found for model in reversed(models) for found in model.images)
    registered = {found.image.digest: found for found in placed if found.image.digest in free}
    shared: dict[str, float] = {}
    # Crops and turned images of one camera have other intrinsics.
    for size in {found.image.size for found in registered.values()}:
        alike = [found for found in registered.values() if found.image.size == size]
        focal = float(np.median([found.focal for found in alike]))
        near = [found for found in alike if abs(found.focal / focal - 1) < TOLERANCE]
        if len(alike) < MIN_ALIKE or len(near) <= len(alike) / 2:
            continue
        many = ZOOM_POINTS * float(np.median([found.points for found in alike]))
        zoomed = {found.image for found in alike if found not in near and found.points >= many}
        for image in images:
            if image.size == size and image not in zoomed:
                shared[image.digest] = focal
    return shared
