"""Reconstruction of one graph by pycolmap's mapper, or from the poses of a former reconstruction.

A failure is a reason, and no exception: pycolmap may be missing, and a batch without cameras keeps the F of its
pairs.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import MIN_IMAGES, Reconstruction, SfmModel, models_of
from mkpc_kaggle.scene.view_graph import SharedIntrinsics

MIN_PAIRS_PER_IMAGE = 1.35  # connected pairs; with fewer, cameras are poorly constrained
MIN_OBSERVATIONS = 0.99  # share of the observations before another assumption; fewer refuse it

# Reconstructs a graph with shared intrinsics
Make: TypeAlias = Callable[[MergedGraph, SharedIntrinsics], Reconstruction]


@dataclass(frozen=True, eq=False)
class Mapped:
    """The parts of a graph, the reconstruction of each, and the intrinsics that images share.

    Assumptions are tried one after the other: another value of this kind replaces the former one, or not.
    """

    parts: tuple[MergedGraph, ...]
    reconstructions: tuple[Reconstruction, ...]
    shared: SharedIntrinsics

    @classmethod
    def of(cls, parts: Sequence[MergedGraph], shared: SharedIntrinsics, make: Make) -> Self:
        return cls(tuple(parts), tuple(make(part, shared) for part in parts), shared)

    @property
    def models(self) -> tuple[SfmModel, ...]:
        """The models of all parts, the largest first."""
        return models_of(self.reconstructions)

    def __iter__(self) -> Iterator[tuple[MergedGraph, Reconstruction]]:
        """Yield each part with its reconstruction."""
        return zip(self.parts, self.reconstructions, strict=True)


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
    except LookupError as error:  # its message is a mere key
        return Reconstruction(names, failure=f"pycolmap failed: {error!r}")


def refine_complete(
    merged: MergedGraph, shared: SharedIntrinsics, config: SceneConfig, former: Reconstruction
) -> Reconstruction | None:
    """Return the reconstruction with shared intrinsics from the poses of a ``former`` one.

    Return ``None`` if the mapper might do better: some matched images have no common model, or
    images see fewer points than before, so the former poses do not fit the shared intrinsics.
    """
    if not former.models or len(former.models[0].images) < len(merged.graph.matched):
        return None
    refined = reconstruct_connected(merged, shared, config, former.models[:1])
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
