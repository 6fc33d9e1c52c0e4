"""Shared intrinsics: which images of one size have one focal length, and which reconstruction says so.

An image's own focal length is ambiguous with the distance to the scene, and poorly constrained by few points. So
images of one camera at one zoom share it. ``cameras`` of [scene] (``--camera``) says how:

- ``auto``, the default: if at least five images of one size are registered, and more than half of them agree on
  the focal length within 2 %, :func:`share` reconstructs a second time, with their median for all images of this
  size, registered or not. It is refused if images then have fewer than 0.99 of the observations before
  (``MIN_OBSERVATIONS``). Images that see many points with another focal length seem to have another zoom. They
  share only if EXIF does not differ by 10 %, and, where it is unknown, if none of them loses observations.
- ``folder``: the user declares one camera for each size. The first reconstruction already shares it
  (:func:`given_intrinsics`).
- ``image``: no image shares.

Images with a camera of the user's are not compared.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FOCAL_RATIO
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import Reconstruction, SfmModel, models_of
from mkpc_kaggle.scene.view_graph import BatchImage, SharedIntrinsics

TOLERANCE = 0.02  # maximum relative deviation of agreeing focal lengths from the median
MIN_ALIKE = 5  # registered images of one size
# Share of the median number of points; an image with more that disagrees has another zoom
ZOOM_POINTS = 0.5

EXIF_TOLERANCE = 0.1  # of one zoom; values of 35 mm film are rounded to millimetres
MIN_OBSERVATIONS = 0.99  # share of the observations before; fewer refuse shared intrinsics

# Reconstructs a graph with shared intrinsics, from the poses of former models if there are any
Make: TypeAlias = Callable[..., Reconstruction]


def share(
    parts: Sequence[MergedGraph],
    former: Sequence[Reconstruction],
    free: Sequence[BatchImage],
    make: Make,
) -> tuple[list[Reconstruction], SharedIntrinsics] | None:
    """Return reconstructions with shared intrinsics of the ``free`` images that seem to share a
    camera, and these; ``None`` if none do, or if images then see fewer points.

    They start from the poses of the ``former`` reconstructions of the ``parts`` where these are good enough.
    Images that seem to have another zoom share, too, unless they lose points by that.
    """
    models = models_of(former)
    alike = shared_intrinsics(free, models)
    if not alike:
        return None
    everything = shared_intrinsics(free, models, with_zoomed=True)
    if everything.keys() != alike.keys():
        # From these poses alone: most zooms are real, and the mapper takes long.
        together = []
        for part, reconstruction in zip(parts, former, strict=True):
            refined = refine_complete(part, everything, reconstruction, make)
            if refined is not None:
                together.append(refined)
        zoomed = undecided_zooms(free, models)
        is_complete = len(together) == len(parts)
        if is_complete and not loses_points(former, together, zoomed):
            return together, everything
    again = []
    for part, reconstruction in zip(parts, former, strict=True):
        refined = refine_complete(part, alike, reconstruction, make)
        again.append(refined or make(part, alike))
    return None if loses_points(former, again) else (again, alike)


def refine_complete(
    merged: MergedGraph, shared: SharedIntrinsics, former: Reconstruction, make: Make
) -> Reconstruction | None:
    """Return the reconstruction with shared intrinsics from the poses of a ``former`` one.

    Return ``None`` if the mapper might do better: some matched images have no common model, or
    images see fewer points than before, so the former poses do not fit the shared intrinsics.
    """
    if not former.models or len(former.models[0].images) < len(merged.graph.matched):
        return None
    refined = make(merged, shared, former.models[:1])
    if refined.observations < MIN_OBSERVATIONS * former.observations:
        return None
    return refined


def loses_points(
    before: Sequence[Reconstruction],
    after: Sequence[Reconstruction],
    digests: Collection[str] = (),
) -> bool:
    """Return whether all images together, or one of these, see fewer points than before: less than 0.99
    of them.

    Images of two cameras that are forced into one lose points.
    """
    counts = []
    for reconstructions in (before, after):
        points: Counter[str] = Counter()
        for model in models_of(reconstructions):
            points.update({image.image.digest: image.points for image in model.images})
        counts.append(points)
    former, latter = counts
    if latter.total() < MIN_OBSERVATIONS * former.total():
        return True
    return any(latter[digest] < MIN_OBSERVATIONS * former[digest] for digest in digests)


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


def refined_intrinsics(
    images: Sequence[BatchImage], models: Sequence[SfmModel]
) -> SharedIntrinsics:
    """Return the focal length of each image, by the largest model with an image of its size."""
    focals = {
        each.image.size: each.focal for model in reversed(models) for each in model.images
    }
    return {image.digest: focals[image.size] for image in images if image.size in focals}


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
