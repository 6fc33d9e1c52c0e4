"""A batch is reconstructed: pairs in, cameras and the pairs' choices out; plain values that go through a pipe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.choose import Choice, Reason, choose, estimate_at_known_focals
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.reconstruction import MIN_IMAGES, Reconstruction, SfmModel
from mkpc_kaggle.scene.shared_intrinsics import SharedIntrinsics, shared_intrinsics
from mkpc_kaggle.scene.view_graph import MIN_MATCHES, BatchPair, ViewGraph

MIN_PAIRS_PER_IMAGE = 1.35  # connected pairs: with fewer there is little that could contradict the cameras
MIN_OBSERVATIONS = 0.99  # shared intrinsics stay if images see points at least this many times as often as without


@dataclass(frozen=True, eq=False)
class Solution:
    """What is known of a batch: for each pair, in order, its choice, and the reconstructions of its components.

    They are of all matches together; those of single matchers are in the choices alone. An image goes by the name
    under which it came first.
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
    is estimated anew where the scene knows a focal length. With ``export``, all components are reconstructed as
    one view graph, under the names of files, and COLMAP's files are written. Whatever the matches are, the answer
    is a :class:`Solution`: what is missing has a reason. It takes seconds to minutes and may end the process, see
    :mod:`mkpc_kaggle.scene.colmap`.
    """
    directory = None
    if export is not None:
        pairs, directory = [export.original(pair) for pair in pairs], export.directory
    together, shared = reconstruct_sharing(ViewGraph.of_pairs(pairs), config, directory)
    matchers = sorted({name for pair in pairs for name in pair.tracks or ()})
    single = matchers if config.each_matcher and len(matchers) > 1 else []
    alone = [reconstruct_graph(ViewGraph.of_pairs(pairs, name), config, shared) for name in single]
    by_digest = [
        [{found.image.digest: found for found in model.images} for model in models_of(found)]
        for found in (together, *alone)
    ]
    models = [model for found in by_digest for model in found]
    choices = []
    for pair in pairs:
        choice = choose(pair, by_digest)
        if focal is not None and choice.reason not in (Reason.SCENE, Reason.SAME_IMAGE):
            F = estimate_at_known_focals(pair, models, shared, focal, magsac or RobustConfig())
            choice = replace(choice, F=F)
        choices.append(choice)
    return Solution(together, tuple(choices))


def reconstruct_sharing(
    graph: ViewGraph, config: SceneConfig, directory: Path | None = None
) -> tuple[tuple[Reconstruction, ...], SharedIntrinsics]:
    """The reconstruction of each component, and the intrinsics that its images share.

    Images that seem to share a camera are reconstructed anew with it, unless they see fewer points then. COLMAP's
    files are written to ``directory``.
    """
    found = reconstruct_graph(graph, config, {}, directory)
    shared = shared_intrinsics(graph.images, models_of(found), config.shared_intrinsics)
    if shared:
        anew = reconstruct_graph(graph, config, shared, directory)
        before, after = (sum(each.observations for each in made) for made in (found, anew))
        if after >= MIN_OBSERVATIONS * before:
            return anew, shared
        if directory is not None:  # which has the files of the other
            reconstruct_graph(graph, config, {}, directory)
    return found, {}


def reconstruct_graph(
    graph: ViewGraph, config: SceneConfig, shared: SharedIntrinsics, directory: Path | None = None
) -> tuple[Reconstruction, ...]:
    """The reconstruction of each component; of the whole graph, if COLMAP's files go to a ``directory``."""
    if directory is not None:
        strong = tuple(edge for edge in graph.edges if len(edge.matches) >= MIN_MATCHES)
        return (reconstruct_connected(replace(graph, edges=strong), config, shared, directory),)
    return tuple(reconstruct_component(component, config, shared) for component in graph.components())


def reconstruct_component(graph: ViewGraph, config: SceneConfig, shared: SharedIntrinsics) -> Reconstruction:
    """The reconstruction of a connected graph, or why there is none."""
    names, pairs = tuple(image.name for image in graph.images), len(graph.edges)
    if len(names) < MIN_IMAGES:
        return Reconstruction(names, failure=f"{len(names)} images are connected; a scene needs {MIN_IMAGES}")
    if pairs < MIN_PAIRS_PER_IMAGE * len(names):
        few = f"{pairs} pairs connect {len(names)} images; a scene needs {MIN_PAIRS_PER_IMAGE:g} an image"
        return Reconstruction(names, failure=few)
    return reconstruct_connected(graph, config, shared)


def reconstruct_connected(
    graph: ViewGraph, config: SceneConfig, shared: SharedIntrinsics, directory: Path | None = None
) -> Reconstruction:
    """What pycolmap makes of a graph, or why there is nothing."""
    names = tuple(image.name for image in graph.images)
    try:
        from mkpc_kaggle.scene.colmap import structure_from_motion

        return structure_from_motion(graph, config, shared, directory)
    except ImportError as error:
        return Reconstruction(names, failure=f"pycolmap cannot be imported: {error}")
    except (RuntimeError, ValueError) as error:
        return Reconstruction(names, failure=f"pycolmap failed: {error}")


def models_of(reconstructions: Sequence[Reconstruction]) -> list[SfmModel]:
    return [model for found in reconstructions for model in found.models]
