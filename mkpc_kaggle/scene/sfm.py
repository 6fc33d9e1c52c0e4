"""Reconstruction of a batch: from pairs to cameras and a choice of F for each pair, all picklable."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene.align import align, read_reference
from mkpc_kaggle.scene.assumptions import compared, with_lenses, with_right_exif
from mkpc_kaggle.scene.choose import Choice, choose
from mkpc_kaggle.scene.export import HeldDirectory
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.mapper import reconstruct_component, reconstruct_connected
from mkpc_kaggle.scene.models import Reconstruction, models_of
from mkpc_kaggle.scene.shared_intrinsics import (
    given_intrinsics,
    refined_intrinsics,
    share,
)
from mkpc_kaggle.scene.view_graph import (
    BatchPair,
    SharedIntrinsics,
    ViewGraph,
)


@dataclass(frozen=True, eq=False)
class Solution:
    """The reconstructions of a batch's components, and a choice for each pair, in the order of the
    pairs.

    Images with the same content have the name of the first of them. ``disagreement`` is the value by which
    candidates are compared (:mod:`mkpc_kaggle.scene.candidates`).
    """

    reconstructions: tuple[Reconstruction, ...]
    choices: tuple[Choice, ...]
    disagreement: float = 0.0


def reconstruct_batch(
    pairs: Sequence[BatchPair],
    config: SceneConfig,
    focal: FocalConfig | None = None,
    magsac: RobustConfig | None = None,
    export: HeldDirectory | None = None,
    is_whole: bool = False,
    *,
    cameras: Rows = (),
) -> Solution:
    """Reconstruct every connected component of a batch, and choose an F for each of its pairs.

    With the recipe's prior ``focal``, a pair without an F from cameras is re-estimated at the scene's focal
    lengths, unless the pair contradicts the scene. ``magsac`` has default settings if ``None``. With a directory
    ``export``, the batch is reconstructed as a whole, and COLMAP's files are written there. With ``is_whole``, it
    is reconstructed in the same way without files. ``cameras`` are the user's known cameras.

    A missing result has a reason; bad matches never raise. Reconstruction takes seconds to minutes
    and may end the process, see :mod:`mkpc_kaggle.scene.colmap`.
    """
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(cameras)
    reconstructions, shared = reconstruct_graph(graph, config, export, is_whole)
    models = [
        {image.image.digest: image for image in model.images}
        for model in models_of(reconstructions)
    ]
    # From the first model with the image, else from the image's shared camera
    focals = dict(shared)
    for model in reversed(models):
        focals |= {digest: image.focal for digest, image in model.items()}
    # A reason for each pair, also for those without an F
    choices = tuple(choose(pair, models, focals, focal, magsac) for pair in pairs)
    return Solution(tuple(reconstructions), choices)


def reconstruct_graph(
    graph: ViewGraph,
    config: SceneConfig,
    directory: HeldDirectory | None = None,
    is_whole: bool = False,
) -> tuple[list[Reconstruction], SharedIntrinsics]:
    """Return the reconstruction of each component, and the shared intrinsics of the images.

    Assumptions are tried one after the other: EXIF's focal lengths
    (:func:`mkpc_kaggle.scene.assumptions.with_right_exif`), cameras that images share
    (:mod:`mkpc_kaggle.scene.shared_intrinsics`), and lenses without distortion
    (:func:`mkpc_kaggle.scene.assumptions.with_lenses`). The refined focal lengths are returned.

    With a ``directory``, the graph is reconstructed as a whole, moved onto the cameras of the last complete run,
    and COLMAP's files are written there. With ``is_whole``, it is reconstructed as a whole without files.
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
    free = graph.free
    given = given_intrinsics(free, config)
    mapped = with_right_exif(parts, given, config, make)
    if config.cameras is CameraSharing.AUTO:
        mapped = share(mapped, free, config, make) or mapped
    mapped = compared(mapped)
    if config.camera_model is CameraModel.AUTO:
        mapped = with_lenses(mapped, free, config, make) or mapped
    reconstructions = list(mapped.reconstructions)
    shared = mapped.shared
    if directory is not None:
        from mkpc_kaggle.scene.colmap import write_files

        # Before the files are written, so that files and results agree
        reconstructions = align(reconstructions, read_reference(directory.path))
        write_files(directory, mapped.parts[0], shared, models_of(reconstructions), config)
    # Images without a camera have the refined focal length, and not the one it began with.
    if given:
        shared = refined_intrinsics(free, models_of(reconstructions))
    return reconstructions, shared
