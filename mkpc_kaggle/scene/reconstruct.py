"""A batch is reconstructed: pairs in, cameras and the pairs' choices out; plain values that go through a pipe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.choose import Choice, Reason, choose, estimate_at_known_focals
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.reconstruction import MIN_IMAGES, Reconstruction, SfmModel
from mkpc_kaggle.scene.shared_intrinsics import SharedIntrinsics, given_intrinsics, shared_intrinsics
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

MIN_PAIRS_PER_IMAGE = 1.35  # connected pairs: with fewer there is little that could contradict the cameras
KEEPS_ITS_F = Reason.SCENE, Reason.SAME_IMAGE, Reason.CONTRADICTION  # no other F, at the scene's focal lengths
MIN_OBSERVATIONS = 0.99  # shared intrinsics stay if images see points at least this many times as often as without


@dataclass(frozen=True, eq=False)
class Solution:
    """The reconstructions of a batch's components, and the choice of each pair, in order.

    An image has the name under which it came first.
    """

    reconstructions: tuple[Reconstruction, ...]
    choices: tuple[Choice, ...]


def reconstruct_batch(
    pairs: Sequence[BatchPair],
    config: SceneConfig,
    focal: FocalConfig | None = None,
    magsac: RobustConfig | None = None,
    export: Export | None = None,
) -> Solution:
    """Reconstruct every connected component of a batch, and choose an F for each of its pairs.

    With ``focal``, the recipe's prior, and ``magsac`` (default: its defaults), a pair that gets no F from cameras
    is re-estimated where the scene knows a focal length, unless it contradicts the scene. With ``export``, the
    batch is reconstructed as a whole, and COLMAP's files are written.

    A missing result has a reason, and no matches raise an error. It takes seconds to minutes and may end the
    process, see :mod:`mkpc_kaggle.scene.colmap`.
    """
    found, shared = reconstruct_sharing(ViewGraph.of_pairs(pairs), config, export.directory if export else None)
    models = [{image.image.digest: image for image in model.images} for model in models_of(found)]
    focals = dict(shared)  # an image's is that of the first model that has it, else of the camera that it shares
    for model in reversed(models):
        focals |= {digest: image.focal for digest, image in model.items()}
    choices = []
    for pair in pairs:
        choice = choose(pair, models)
        if focal is not None and choice.reason not in KEEPS_ITS_F:
            F = estimate_at_known_focals(pair, focals, focal, magsac or RobustConfig())
            choice = replace(choice, F=F)
        choices.append(choice)
    return Solution(tuple(found), tuple(choices))


def reconstruct_sharing(
    graph: ViewGraph, config: SceneConfig, directory: Path | None = None
) -> tuple[list[Reconstruction], SharedIntrinsics]:
    """The reconstruction of each component, and the intrinsics that its images share.

    Images that seem to share a camera are reconstructed anew with it, unless they see fewer points then. Images
    that are known to share a camera do so at once; the answer has the focal length that was found for it. With a
    ``directory`` the graph is reconstructed as a whole, and COLMAP's files are written there.
    """
    if directory is None:
        parts, make = graph.components(), reconstruct_component
    else:
        parts, make = (graph.strong,), reconstruct_connected
    given = shared = given_intrinsics(graph.images, config)
    found = [make(part, config, shared) for part in parts]
    tolerance = config.shared_intrinsics if config.cameras is CameraSharing.AUTO else 0.0
    if alike := shared_intrinsics(graph.images, models_of(found), tolerance):
        anew = [make(part, config, alike) for part in parts]
        before, after = (sum(each.observations for each in made) for made in (found, anew))
        if after >= MIN_OBSERVATIONS * before:
            found, shared = anew, alike
    if directory is not None:
        from mkpc_kaggle.scene.colmap import write_files

        write_files(directory, graph.strong, config, shared, models_of(found))
    if given:
        focals = {each.image.size: each.focal for model in reversed(models_of(found)) for each in model.images}
        shared = {image.digest: focals[image.size] for image in graph.images if image.size in focals}
    return found, shared


def reconstruct_component(graph: ViewGraph, config: SceneConfig, shared: SharedIntrinsics) -> Reconstruction:
    """The reconstruction of a connected graph, or why there is none."""
    images, pairs = len(graph.images), len(graph.edges)
    if images < MIN_IMAGES:
        return Reconstruction(graph.names, failure=f"{images} images are connected; a scene needs {MIN_IMAGES}")
    if pairs < MIN_PAIRS_PER_IMAGE * images:
        few = f"{pairs} pairs connect {images} images; a scene needs {MIN_PAIRS_PER_IMAGE:g} an image"
        return Reconstruction(graph.names, failure=few)
    return reconstruct_connected(graph, config, shared)


def reconstruct_connected(graph: ViewGraph, config: SceneConfig, shared: SharedIntrinsics) -> Reconstruction:
    """What pycolmap makes of a graph, or why there is nothing."""
    try:
        from mkpc_kaggle.scene.colmap import structure_from_motion

        return structure_from_motion(graph, config, shared)
    except ImportError as error:
        return Reconstruction(graph.names, failure=f"pycolmap cannot be imported: {error}")
    except (RuntimeError, ValueError) as error:
        return Reconstruction(graph.names, failure=f"pycolmap failed: {error}")


def models_of(reconstructions: Sequence[Reconstruction]) -> list[SfmModel]:
    return [model for found in reconstructions for model in found.models]
