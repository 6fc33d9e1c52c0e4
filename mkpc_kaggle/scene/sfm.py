"""Reconstruction of a batch: from pairs to cameras and a choice of F for each pair, all picklable."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.intrinsics import KnownCamera, PlacedCamera, Rows
from mkpc_kaggle.geometry.robust import Estimate, RobustConfig
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene.align import align, read_reference
from mkpc_kaggle.scene.choose import Choice, choose, estimate_of
from mkpc_kaggle.scene.export import HeldDirectory
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import (
    HARDLY_MOVED,
    MAX_CENTRE_SIGMA,
    MIN_IMAGES,
    Reconstruction,
    SfmModel,
)
from mkpc_kaggle.scene.motion import hardly_moved
from mkpc_kaggle.scene.shared_intrinsics import (
    TOLERANCE,
    SharedIntrinsics,
    given_intrinsics,
    shared_intrinsics,
    undecided_zooms,
)
from mkpc_kaggle.scene.view_graph import (
    BatchImage,
    BatchPair,
    ViewGraph,
    known_by_name,
    placed_by_name,
)

MIN_PAIRS_PER_IMAGE = 1.35  # connected pairs; with fewer, cameras are poorly constrained
MIN_REGISTERED = 0.5  # share of the matched images; fewer may be due to wrong focal lengths of EXIF
MAX_EXIF_LOG_DEVIATION = float(np.log(1.3))  # of a refined focal length; EXIF is then wrong
MIN_OBSERVATIONS = 0.99  # share of the observations before sharing; with fewer, sharing is dropped

# Reconstructs a graph with shared intrinsics
Make: TypeAlias = Callable[[MergedGraph, SharedIntrinsics], Reconstruction]


@dataclass(frozen=True, eq=False)
class Solution:
    """The reconstructions of a batch's components, and a choice for each pair, in the order of the
    pairs.

    Images with the same content have the name of the first of them. ``disagreement`` is the value by which
    candidates are compared (:mod:`mkpc_kaggle.scene.candidates`). ``estimates``, if asked for, has the estimate
    of each pair that takes its F from its cameras.
    """

    reconstructions: tuple[Reconstruction, ...]
    choices: tuple[Choice, ...]
    disagreement: float = 0.0
    estimates: tuple[Estimate | None, ...] = ()


def reconstruct_batch(
    pairs: Sequence[BatchPair],
    config: SceneConfig,
    focal: FocalConfig | None = None,
    magsac: RobustConfig | None = None,
    export: HeldDirectory | None = None,
    is_whole: bool = False,
    *,
    cameras: Rows = (),
    with_estimates: bool = False,
) -> Solution:
    """Reconstruct every connected component of a batch, and choose an F for each of its pairs.

    With the recipe's prior ``focal``, a pair without an F from cameras is re-estimated at the scene's focal
    lengths, unless the pair contradicts the scene. ``magsac`` has default settings if ``None``. With a directory
    ``export``, the batch is reconstructed as a whole, and COLMAP's files are written there. With ``is_whole``, it
    is reconstructed in the same way without files. ``cameras`` are the user's known cameras. ``with_estimates``,
    pairs come without their own F, and get estimates from their cameras.

    A missing result has a reason; bad matches never raise. Reconstruction takes seconds to minutes
    and may end the process, see :mod:`mkpc_kaggle.scene.colmap`.
    """
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(cameras)
    reconstructions, shared = reconstruct_sharing(graph, config, export, is_whole)
    models = [
        {image.image.digest: image for image in model.images}
        for model in models_of(reconstructions)
    ]
    # From the first model with the image, else from the image's shared camera
    focals = dict(shared)
    for model in reversed(models):
        focals |= {digest: image.focal for digest, image in model.items()}
    # A reason for each pair, also for those without an F
    choices = []
    estimates = []
    for pair in pairs:
        choice = choose(pair, models, focals, focal, magsac, may_estimate=with_estimates)
        choices.append(choice)
        if with_estimates:
            estimates.append(estimate_of(choice, pair, magsac or RobustConfig()))
    return Solution(tuple(reconstructions), tuple(choices), estimates=tuple(estimates))


def reconstruct_sharing(
    graph: ViewGraph,
    config: SceneConfig,
    directory: HeldDirectory | None = None,
    is_whole: bool = False,
) -> tuple[list[Reconstruction], SharedIntrinsics]:
    """Return the reconstruction of each component, and the shared intrinsics of the images.

    If cameras are missing or doubtful that started with EXIF's focal lengths, a reconstruction
    without these is tried, and the one with more observations is kept. If images seem to share a
    camera, a further reconstruction shares intrinsics, see :func:`share`.
    If the recipe shares cameras, the first reconstruction does too. The refined focal lengths are
    returned. With a ``directory``, the graph is reconstructed as a whole, moved onto the cameras of
    the last complete run, and COLMAP's files are written there. With ``is_whole``, it is reconstructed
    as a whole without files.
    """
    if directory is None and not is_whole:
        # Each component alone, since a bad one may make the mapper fail
        parts = list(map(MergedGraph, graph.components()))
        make = partial(reconstruct_component, config=config)
    else:
        # COLMAP's database holds all images of a folder.
        parts = [MergedGraph(graph.strong)]
        make = partial(reconstruct_connected, config=config)
    # The user's cameras are neither compared nor shared.
    free = free_of(graph)
    lenses = placed_lenses(graph) if config.camera_model is CameraModel.AUTO else {}
    parts = [part.starting_with(lenses=lenses) for part in parts]
    given = given_intrinsics(free, config)
    parts, reconstructions, shared = with_right_exif(parts, given, config, make)
    if config.cameras is not CameraSharing.IMAGE:
        parts, reconstructions = sharing_with_placed(parts, reconstructions, shared, make)
        known = {digest for part in parts for digest in part.graph.known}
        free = [image for image in free if image.digest not in known]
    if config.cameras is CameraSharing.AUTO:
        sharing = share(parts, reconstructions, free, config, make)
        if sharing is not None:
            reconstructions, shared = sharing
    reconstructions = [
        compared(part, reconstruction)
        for part, reconstruction in zip(parts, reconstructions, strict=True)
    ]
    if config.camera_model is CameraModel.AUTO:
        adopted = with_lenses(parts, reconstructions, free, config, make)
        if adopted is not None:
            parts, reconstructions, shared = adopted
    if directory is not None:
        from mkpc_kaggle.scene.colmap import write_files

        # Before the files are written, so that files and results agree. Placed cameras have a world.
        if not placed_by_name(graph):
            reconstructions = align(reconstructions, read_reference(directory.path))
        write_files(directory, parts[0], shared, models_of(reconstructions), config)
    # Images without a camera have the refined focal length, and not the one it began with.
    if given:
        shared = refined_intrinsics(free, models_of(reconstructions))
    return reconstructions, shared


def free_of(graph: ViewGraph) -> list[BatchImage]:
    """Return the images of a graph without the user's cameras."""
    return [image for image in graph.images if image.digest not in graph.known]


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
        starts = given_intrinsics(free_of(part.graph), config, uses_exif=False)
        second = make(other, {**given, **starts})
        if second.observations > reconstructions[number].observations:
            shared = {**shared, **starts}
            chosen[number] = other
            reconstructions[number] = second
    return chosen, reconstructions, shared


def placed_lenses(graph: ViewGraph) -> dict[str, KnownCamera]:
    """Return the distorted lens of a finished model for its new images of the same size, by digest."""
    lenses: dict[Size, KnownCamera] = {}
    for image in graph.images:
        camera = graph.known.get(image.digest)
        if isinstance(camera, PlacedCamera) and any(camera.distortion):
            lenses.setdefault(image.size, KnownCamera(camera.model, camera.parameters))
    return {image.digest: lenses[image.size] for image in free_of(graph) if image.size in lenses}


def sharing_with_placed(
    parts: Sequence[MergedGraph],
    reconstructions: Sequence[Reconstruction],
    shared: SharedIntrinsics,
    make: Make,
) -> tuple[list[MergedGraph], list[Reconstruction]]:
    """Return the graphs and the reconstructions with the intrinsics of :func:`with_placed_intrinsics`,
    unless images then see fewer points.
    """
    chosen = list(parts)
    found = list(reconstructions)
    for number, part in enumerate(parts):
        placed = with_placed_intrinsics(part, found[number])
        if placed is None:
            continue
        again = make(placed, shared)
        if not loses_points([found[number]], [again]):
            chosen[number] = placed
            found[number] = again
    return chosen, found


def with_placed_intrinsics(part: MergedGraph, reconstruction: Reconstruction) -> MergedGraph | None:
    """Return the graph whose new images have the intrinsics of a finished model, or ``None`` if no new
    image has them.

    The model's images of the size must have one camera, and the new focal length must agree. A
    single new image determines its focal length poorly.
    """
    known = part.graph.known
    lenses: dict[Size, set[KnownCamera]] = {}
    for image in part.graph.images:
        camera = known.get(image.digest)
        if isinstance(camera, PlacedCamera):
            lens = KnownCamera(camera.model, camera.parameters)
            lenses.setdefault(image.size, set()).add(lens)
    alike = {}
    for registered in (
        registered for model in reconstruction.models for registered in model.images
    ):
        image = registered.image
        of_size = lenses.get(image.size, set())
        if image.digest in known or len(of_size) != 1:
            continue
        (lens,) = of_size
        if abs(registered.focal / lens.focal - 1) < TOLERANCE:
            alike[image.digest] = lens
    return part.starting_with(known={**known, **alike}) if alike else None


def doubts_exif(graph: ViewGraph, reconstruction: Reconstruction) -> bool:
    """Return whether wrong focal lengths of EXIF may be why cameras are missing or doubtful."""
    if not any(image.focal for image in free_of(graph)):
        return False
    matched = {image for edge in graph.edges for image in (edge.first, edge.second)}
    if not reconstruction.models or reconstruction.registered < MIN_REGISTERED * len(matched):
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
    return bool(contradicting) and reconstruction.registered < len(matched)


def share(
    parts: Sequence[MergedGraph],
    reconstructions: list[Reconstruction],
    free: Sequence[BatchImage],
    config: SceneConfig,
    make: Make,
) -> tuple[list[Reconstruction], SharedIntrinsics] | None:
    """Return reconstructions with shared intrinsics of the ``free`` images that seem to share a
    camera, or ``None`` if none do, or if images then see fewer points.

    They start from the poses ``reconstructions`` where these are good enough. Images that seem to have another
    zoom share, too, unless they lose points by that.
    """
    models = models_of(reconstructions)
    alike = shared_intrinsics(free, models)
    if not alike:
        return None
    everything = shared_intrinsics(free, models, with_zoomed=True)
    if everything.keys() != alike.keys():
        # From these poses alone: most zooms are real, and the mapper takes long.
        together = []
        for part, former in zip(parts, reconstructions, strict=True):
            refined = refine_complete(part, everything, config, former)
            if refined is not None:
                together.append(refined)
        zoomed = undecided_zooms(free, models)
        if len(together) == len(parts) and not loses_points(reconstructions, together, zoomed):
            return together, everything
    again = []
    for part, former in zip(parts, reconstructions, strict=True):
        refined = refine_complete(part, alike, config, former)
        again.append(refined or make(part, alike))
    return None if loses_points(reconstructions, again) else (again, alike)


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


def loses_points(
    before: Sequence[Reconstruction],
    after: Sequence[Reconstruction],
    digests: Collection[str] = (),
) -> bool:
    """Return whether all images together, or one of these, see fewer points than before.

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


def refined_intrinsics(
    images: Sequence[BatchImage], models: Sequence[SfmModel]
) -> SharedIntrinsics:
    """Return the focal length of each image, by the largest model with an image of its size."""
    focals = {each.image.size: each.focal for model in reversed(models) for each in model.images}
    return {image.digest: focals[image.size] for image in images if image.size in focals}


def reconstruct_component(
    merged: MergedGraph, shared: SharedIntrinsics, config: SceneConfig
) -> Reconstruction:
    """Return the reconstruction of a connected graph, or the reason for its failure."""
    graph = merged.graph
    images = len(graph.images)
    pairs = len(graph.edges)
    if images < MIN_IMAGES:
        return Reconstruction(
            graph.names, failure=f"{images} images are connected; a scene needs {MIN_IMAGES}"
        )
    if pairs < MIN_PAIRS_PER_IMAGE * images:
        few = (
            f"{pairs} matched pairs connect {images} images, and reliable cameras need "
            f"{math.ceil(MIN_PAIRS_PER_IMAGE * images)}; more overlapping images would help"
        )
        return Reconstruction(graph.names, failure=few)
    return reconstruct_connected(merged, shared, config)


def refine_complete(
    merged: MergedGraph, shared: SharedIntrinsics, config: SceneConfig, former: Reconstruction
) -> Reconstruction | None:
    """Return the reconstruction with shared intrinsics from the poses of a ``former`` one.

    Return ``None`` if the mapper might do better: some matched images have no common model, or
    images see fewer points than before, so the former poses do not fit the shared intrinsics.
    """
    matched = {image for edge in merged.graph.edges for image in (edge.first, edge.second)}
    if not former.models or len(former.models[0].images) < len(matched):
        return None
    refined = reconstruct_connected(merged, shared, config, former.models[:1])
    if refined.observations < MIN_OBSERVATIONS * former.observations:
        return None
    return refined


def reconstruct_connected(
    merged: MergedGraph,
    shared: SharedIntrinsics,
    config: SceneConfig,
    former: Sequence[SfmModel] = (),
) -> Reconstruction:
    """Return pycolmap's reconstruction of a graph, or the reason for its failure.

    With ``former`` models, their poses are refined.
    """
    names = merged.graph.names
    # Only a batch is lost: pairs keep their own F.
    try:
        # Here, because pycolmap may be missing and is slow to import
        from mkpc_kaggle.scene.colmap import structure_from_motion

        return structure_from_motion(merged, shared, config, former)
    except ImportError as error:
        return Reconstruction(names, failure=f"pycolmap cannot be imported: {error}")
    except (RuntimeError, ValueError) as error:
        return Reconstruction(names, failure=f"pycolmap failed: {error}")


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


def models_of(reconstructions: Sequence[Reconstruction]) -> tuple[SfmModel, ...]:
    """Return the models of all reconstructions, the largest first."""
    models = (model for found in reconstructions for model in found.models)
    return tuple(sorted(models, key=lambda model: -len(model.images)))
