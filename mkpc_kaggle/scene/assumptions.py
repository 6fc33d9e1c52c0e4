"""Assumptions about lenses that the photographs may contradict: EXIF's focal lengths, no distortion.

If they do, a second reconstruction does without the assumption.

- EXIF is doubted if fewer than half of the matched images have a camera, or if the largest model is loose. A
  focal length that moved by 30 % is another doubt, if some images have no camera. The second reconstruction stays
  if it has more observations.
- A lens without distortion is doubted by :mod:`mkpc_kaggle.scene.comparison`. The second reconstruction stays
  unless images lose points (:func:`mkpc_kaggle.scene.mapper.loses_points`).

:mod:`mkpc_kaggle.scene.shared_intrinsics` does the same for shared cameras.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.mapper import Make, Mapped, loses_points
from mkpc_kaggle.scene.models import HARDLY_MOVED, MAX_CENTRE_SIGMA, Reconstruction, SfmModel
from mkpc_kaggle.scene.motion import hardly_moved
from mkpc_kaggle.scene.shared_intrinsics import given_intrinsics, share
from mkpc_kaggle.scene.view_graph import BatchImage, SharedIntrinsics, ViewGraph, known_by_name

MIN_REGISTERED = 0.5  # share of the matched images; fewer may be due to wrong focal lengths of EXIF
MAX_EXIF_LOG_DEVIATION = float(np.log(1.3))  # of a refined focal length; EXIF is then wrong


def with_right_exif(
    parts: Sequence[MergedGraph], given: SharedIntrinsics, config: SceneConfig, make: Make
) -> Mapped:
    """Return the reconstructions without EXIF's focal lengths where these are wrong. ``given`` are the
    initial intrinsics.
    """
    shared = given
    chosen = []
    reconstructions = []
    for part, first in Mapped.of(parts, given, make):
        chosen.append(part)
        reconstructions.append(first)
        if not doubts_exif(part.graph, first):
            continue
        other = part.starting_with(uses_exif=False)
        starts = given_intrinsics(part.graph.free, config, uses_exif=False)
        second = make(other, {**given, **starts})
        if second.observations > first.observations:
            shared = {**shared, **starts}
            chosen[-1] = other
            reconstructions[-1] = second
    return Mapped(tuple(chosen), tuple(reconstructions), shared)


def doubts_exif(graph: ViewGraph, reconstruction: Reconstruction) -> bool:
    """Return whether wrong focal lengths of EXIF may be why cameras are missing or doubtful."""
    if not any(image.focal for image in graph.free):
        return False
    matched = len(graph.matched)
    if not reconstruction.models or reconstruction.registered < MIN_REGISTERED * matched:
        return True
    if reconstruction.models[0].is_loose:
        return True
    # Some EXIF is wrong, so that of the images without a camera may be wrong, too.
    contradicting = [
        registered.image
        for registered in reconstruction.models[0].images
        if registered.image.focal
        and abs(np.log(registered.focal / registered.image.focal)) > MAX_EXIF_LOG_DEVIATION
    ]
    return bool(contradicting) and reconstruction.registered < matched


def with_lenses(
    pinholes: Mapped, free: Sequence[BatchImage], config: SceneConfig, make: Make
) -> Mapped | None:
    """Return reconstructions with the distorted lenses that ``pinholes`` show, or ``None`` if they
    show none, or if images then see fewer points.
    """
    sizes = {image.name: image.size for image in free}
    shown: dict[Size, KnownCamera] = {}
    for lens in (lens for model in pinholes.models for lens in model.comparison.lenses):
        # A pinhole that the user gives stays one. Of several models, the largest counts.
        for name in lens.images:
            if name in sizes and not lens.is_adopted:
                shown.setdefault(sizes[name], lens.camera)
    if not shown:
        return None
    # Images of one size share a lens, with and without a camera so far.
    lenses = {image.digest: shown[image.size] for image in free if image.size in shown}
    parts = [part.starting_with(lenses={**part.graph.lenses, **lenses}) for part in pinholes.parts]
    given = given_intrinsics(free, config)
    shared: SharedIntrinsics = {
        digest: lenses[digest].focal if digest in lenses else focal
        for digest, focal in given.items()
    }
    # From the matches: pinholes have bent the poses, too.
    bent = Mapped.of(parts, shared, make)
    if config.cameras is CameraSharing.AUTO:
        bent = share(bent, free, config, make) or bent
    if loses_points(pinholes.reconstructions, bent.reconstructions):
        return None
    return compared(bent)


def compared(mapped: Mapped) -> Mapped:
    """Return the reconstructions with the assumptions that their photographs contradict."""
    return replace(mapped, reconstructions=tuple(_compared(*part) for part in mapped))


def _has_moved(merged: MergedGraph, models: Sequence[SfmModel]) -> bool:
    """Return whether cameras were at different places. Certain cameras have moved, also if most edges are
    rotations, as of neighbours in a film.
    """
    sigma = models[0].centre_sigma if models else inf
    if sigma is not None and sigma <= MAX_CENTRE_SIGMA:
        return True
    if not hardly_moved(merged):
        return True
    if sigma is not None:
        return False
    # Only with a model: pycolmap may be missing
    from mkpc_kaggle.scene.uncertainty import centre_sigma_of_part

    return centre_sigma_of_part(models[0]) <= MAX_CENTRE_SIGMA


def _compared(merged: MergedGraph, reconstruction: Reconstruction) -> Reconstruction:
    """Return the reconstruction with the assumptions that its photographs contradict."""
    has_moved = _has_moved(merged, reconstruction.models)
    if not reconstruction.models:
        return reconstruction if has_moved else replace(reconstruction, failure=HARDLY_MOVED)
    # Only with a model: pycolmap may be missing
    from mkpc_kaggle.scene.comparison import adopted_lenses_of, compare_with_photographs

    given_cameras = known_by_name(merged.graph)
    models = []
    for model in reconstruction.models:
        comparison = replace(compare_with_photographs(model, given_cameras), has_moved=has_moved)
        lenses = (*adopted_lenses_of(model, merged.graph.lenses), *comparison.lenses)
        comparison = replace(comparison, lenses=lenses)
        models.append(replace(model, comparison=comparison))
    return replace(reconstruction, models=tuple(models))
