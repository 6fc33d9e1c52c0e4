"""Shared intrinsics of images from one camera at one zoom, detected by their focal lengths.

An image's own focal length is ambiguous with the distance to the scene, and poorly constrained by
few points. If most images of one size agree on the focal length, one camera is assumed. A second
reconstruction then has shared intrinsics. If the user declares one camera, the first reconstruction
already has shared intrinsics (``cameras`` of [scene], ``--camera``). It is :func:`mkpc_kaggle.scene.sfm.share`
that reconstructs again, and refuses the result if images then see fewer points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FOCAL_RATIO
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

TOLERANCE = 0.02  # maximum relative deviation of agreeing focal lengths from the median
MIN_ALIKE = 5  # registered images of one size
# Share of the median number of points; an image with more that disagrees has another zoom
ZOOM_POINTS = 0.5

EXIF_TOLERANCE = 0.1  # of one zoom; values of 35 mm film are rounded to millimetres

# By image digest: the focal length, in pixels, of the camera that images of one size share.
SharedIntrinsics: TypeAlias = Mapping[str, float]


def start_focal(image: BatchImage, *, uses_exif: bool = True) -> float:
    """Return the initial focal length of an image's camera, in pixels; from EXIF if known."""
    return (uses_exif and image.focal) or FOCAL_RATIO * max(image.size)


def given_intrinsics(
    images: Sequence[BatchImage], config: SceneConfig, *, uses_exif: bool = True
) -> SharedIntrinsics:
    """Return one initial focal length for all images of a size, if the recipe shares cameras.

    The ``images`` are those whose intrinsics the user does not know, as in
    :func:`shared_intrinsics`.
    """
    if config.cameras is not CameraSharing.FOLDER:
        return {}
    starts = {}
    for size in {image.size for image in images}:
        known = [image.focal for image in images if image.size == size and image.focal]
        known = known if uses_exif else []
        starts[size] = float(np.median(known)) if known else FOCAL_RATIO * max(size)
    return {image.digest: starts[image.size] for image in images}


def shared_intrinsics(
    images: Sequence[BatchImage], models: Sequence[SfmModel], *, with_zoomed: bool = False
) -> SharedIntrinsics:
    """Return, for each image size, the focal length on which more than half of the registered
    images agree.

    All images of the size, registered or not, share the median focal length. Exceptions are images
    that see many points at another focal length, since they have another zoom. A frontal view of a
    flat scene determines no focal length, and seems to have one: ``with_zoomed`` includes these
    images, unless EXIF says that their zoom differs.
    """
    shared: dict[str, float] = {}
    for size, group in _agreeing(images, models).items():
        for image in images:
            if image.size != size:
                continue
            is_apart = image.digest in group.zoomed
            if with_zoomed:
                is_apart = is_apart and group.exif_ratio(image) > EXIF_TOLERANCE
            if not is_apart:
                shared[image.digest] = group.focal
    return shared


def undecided_zooms(images: Sequence[BatchImage], models: Sequence[SfmModel]) -> set[str]:
    """Return the digests of images that seem to have another zoom, and whose EXIF is no evidence."""
    groups = _agreeing(images, models)
    undecided = set()
    for image in images:
        group = groups.get(image.size)
        # With both focal lengths, EXIF decides.
        is_decided = group is not None and group.exif and image.focal
        if group is not None and image.digest in group.zoomed and not is_decided:
            undecided.add(image.digest)
    return undecided


@dataclass(frozen=True)
class _Group:
    """Images of one size; most of them agree on a focal length. ``exif`` is the median of EXIF's
    focal lengths of these, 0 if unknown.
    """

    focal: float
    exif: float
    zoomed: frozenset[str]

    def exif_ratio(self, image: BatchImage) -> float:
        """Return by how much an image's EXIF differs from the others'; 0 if one is unknown."""
        if not self.exif or not image.focal:
            return 0.0
        return abs(image.focal / self.exif - 1)


def _agreeing(images: Sequence[BatchImage], models: Sequence[SfmModel]) -> dict[Size, _Group]:
    """Return the groups of images that agree, by size."""
    free = {image.digest for image in images}
    placed = (found for model in reversed(models) for found in model.images)
    registered = {found.image.digest: found for found in placed if found.image.digest in free}
    groups = {}
    # Crops and turned images of one camera have other intrinsics.
    for size in {found.image.size for found in registered.values()}:
        alike = [found for found in registered.values() if found.image.size == size]
        focal = float(np.median([found.focal for found in alike]))
        near = [found for found in alike if abs(found.focal / focal - 1) < TOLERANCE]
        if len(alike) < MIN_ALIKE or len(near) <= len(alike) / 2:
            continue
        many = ZOOM_POINTS * float(np.median([found.points for found in alike]))
        zoomed = [found for found in alike if found not in near and found.points >= many]
        exif = [found.image.focal for found in near if found.image.focal]
        groups[size] = _Group(
            focal,
            float(np.median(exif)) if exif else 0.0,
            frozenset(found.image.digest for found in zoomed),
        )
    return groups
