"""Reconstruction of a batch: from pairs to cameras and a choice of F for each pair, all picklable.

A failure is a reason, and no exception: pycolmap may be missing, and a batch without cameras keeps the F of its
pairs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.choose import Choice, choose
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import MIN_IMAGES, Reconstruction, SfmModel, models_of
from mkpc_kaggle.scene.shared_intrinsics import given_intrinsics, refined_intrinsics, share
from mkpc_kaggle.scene.view_graph import BatchPair, SharedIntrinsics, ViewGraph

MIN_PAIRS_PER_IMAGE = 1.35  # connected pairs; with fewer, cameras are poorly constrained


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
    folder: Path | None = None,
    *,
    cameras: Rows = (),
) -> Solution:
    """Reconstruct every connected component of a batch, and choose an F for each of its pairs.

    With the recipe's prior ``focal``, a pair without an F from cameras is re-estimated at the scene's focal
    lengths, unless the pair contradicts the scene. ``magsac`` has default settings if ``None``. With a
    ``folder``, the batch is reconstructed as a whole, and COLMAP's files are written there. ``cameras`` are the
    user's known cameras.

    A missing result has a reason; bad matches never raise. Reconstruction takes seconds to minutes
    and may end the process, see :mod:`mkpc_kaggle.scene.colmap`.
    """
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(cameras)
    reconstructions, shared = reconstruct_graph(graph, config, folder)
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
    folder: Path | None = None,
) -> tuple[list[Reconstruction], SharedIntrinsics]:
    """Return the reconstruction of each component, and the shared intrinsics of the images, refined.

    With a ``folder``, the graph is reconstructed as a whole, and COLMAP's files are written there.
    """
    if folder is None:
        # Each component alone, since a bad one may make the mapper fail
        parts = list(map(MergedGraph, graph.components()))
        make = partial(reconstruct_component, config=config)
    else:
        # COLMAP's database holds all images of a folder.
        parts = [MergedGraph(graph.strong)]
        make = partial(map_graph, config=config)
    # The user's cameras are not shared.
    shared = given_intrinsics(graph.free, config)
    reconstructions = [make(part, shared) for part in parts]
    if config.cameras is CameraSharing.AUTO:
        again = share(parts, reconstructions, graph.free, make)
        reconstructions, shared = again or (reconstructions, shared)
    if folder is not None:
        from mkpc_kaggle.scene.colmap import write_files

        write_files(folder, parts[0], shared, models_of(reconstructions), config)
    # Images without a camera have the refined focal length, and not the one it began with.
    if config.cameras is CameraSharing.FOLDER:
        shared = refined_intrinsics(graph.free, models_of(reconstructions))
    return reconstructions, shared


def reconstruct_component(
    merged: MergedGraph,
    shared: SharedIntrinsics,
    former: Sequence[SfmModel] = (),
    *,
    config: SceneConfig,
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
    return map_graph(merged, shared, former, config=config)


def map_graph(
    merged: MergedGraph,
    shared: SharedIntrinsics,
    former: Sequence[SfmModel] = (),
    *,
    config: SceneConfig,
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
    except LookupError as error:  # its message is a mere key
        return Reconstruction(names, failure=f"pycolmap failed: {error!r}")
