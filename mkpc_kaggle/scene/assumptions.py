"""Assumptions about lenses that the photographs may contradict: EXIF's focal lengths, no distortion.

If they do, a second reconstruction does without the assumption, and it stays if images see no fewer points.
:mod:`mkpc_kaggle.scene.shared_intrinsics` does the same for shared cameras. The comparison with the
photographs is in :mod:`mkpc_kaggle.scene.comparison`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera, PlacedCamera
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.mapper import Make, loses_points
from mkpc_kaggle.scene.models import HARDLY_MOVED, MAX_CENTRE_SIGMA, Reconstruction, models_of
from mkpc_kaggle.scene.motion import hardly_moved
from mkpc_kaggle.scene.shared_intrinsics import given_intrinsics, share
from mkpc_kaggle.scene.view_graph import BatchImage, SharedIntrinsics, ViewGraph, known_by_name

MIN_REGISTERED = 0.5  # share of the matched images; fewer may be due to wrong focal lengths of EXIF
MAX_EXIF_LOG_DEVIATION = float(np.log(1.3))  # of a refined focal length; EXIF is then wrong


def with_right_exif(
    parts: Sequence[MergedGraph], given: SharedIntrinsics, config: SceneConfig, make: Make
) -> tuple[list[MergedGraph], list[Reconstruction], SharedIntrinsics]:
    """Return the graphs, their reconstructions and the shared intrinsics, without EXIF's focal
    lengths where these are wrong. ``given`` are the initial intrinsics.
    """
    shared = given
    chosen = list(parts)
    reconstructions = [make(part, given) for part in parts]
    for number, part in enumerate(parts):
        if not doubts_exif(part.graph, reconstructions[number]):
            continue
        other = part.starting_with(uses_exif=False)
        starts = given_intrinsics(part.graph.free, config, uses_exif=False)
        second = make(other, {**given, **starts})
        if second.observations > reconstructions[number].observations:
            shared = {**shared, **starts}
            chosen[number] = other
            reconstructions[number] = second
    return chosen, reconstructions, shared


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


def placed_lenses(graph: ViewGraph) -> dict[str, KnownCamera]:
    """Return the distorted lens of a finished model for its new images of the same size, by digest."""
    lenses: dict[Size, KnownCamera] = {}
    for image in graph.images:
        camera = graph.known.get(image.digest)
        if isinstance(camera, PlacedCamera) and any(camera.distortion):
            lenses.setdefault(image.size, KnownCamera(camera.model, camera.parameters))
    return {image.digest: lenses[image.size] for image in graph.free if image.size in lenses}


def with_lenses(
    parts: Sequence[MergedGraph],
    pinholes: Sequence[Reconstruction],
    free: Sequence[BatchImage],
    config: SceneConfig,
    make: Make,
) -> tuple[list[MergedGraph], list[Reconstruction], SharedIntrinsics] | None:
    """Return graphs, reconstructions and shared intrinsics with the distorted lenses that
    ``pinholes`` show, or ``None`` if they show none, or if images then see fewer points.
    """
    sizes = {image.name: image.size for image in free}
    shown: dict[Size, KnownCamera] = {}
    for lens in (lens for model in models_of(pinholes) for lens in model.comparison.lenses):
        # A pinhole that the user gives stays one. Of several models, the largest counts.
        for name in lens.images:
            if name in sizes and not lens.is_adopted:
                shown.setdefault(sizes[name], lens.camera)
    if not shown:
        return None
    # Images of one size share a lens, with and without a camera so far.
    lenses = {image.digest: shown[image.size] for image in free if image.size in shown}
    bent = [part.starting_with(lenses={**part.graph.lenses, **lenses}) for part in parts]
    given = given_intrinsics(free, config)
    shared: SharedIntrinsics = {
        digest: lenses[digest].focal if digest in lenses else focal
        for digest, focal in given.items()
    }
    # From the matches: pinholes have bent the poses, too.
    again: Sequence[Reconstruction] = [make(part, shared) for part in bent]
    if config.cameras is CameraSharing.AUTO:
        sharing = share(bent, list(again), free, config, make)
        again, shared = sharing or (again, shared)
    if loses_points(pinholes, again):
        return None
    return bent, [compared(*both) for both in zip(bent, again, strict=True)], shared


def compared(merged: MergedGraph, reconstruction: Reconstruction) -> Reconstruction:
    """Return the reconstruction with the assumptions that its photographs contradict."""
    # Certain cameras have moved.
    is_doubtful = (
        not reconstruction.models or reconstruction.models[0].centre_sigma > MAX_CENTRE_SIGMA
    )
    has_moved = not (is_doubtful and hardly_moved(merged))
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
