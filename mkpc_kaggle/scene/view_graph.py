"""The view graph of a batch: its distinct images, and the matches between them."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera, Rows
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult

# Of a connecting edge; also the minimum number of inliers of a verified edge
MIN_MATCHES = 15
# From units that make tracks; with fewer, a pair uses the matches of all units
MIN_TRACK_MATCHES = 50
# The support of an image is the number of inliers of its edge of this rank. A single edge may join
# copies of one photograph, and says nothing about the others.
SUPPORT_RANK = 3

# By image digest: the focal length, in pixels, of the camera that images of one size share
SharedIntrinsics: TypeAlias = Mapping[str, float]


@dataclass(frozen=True)
class BatchImage:
    """An image of a batch, with the ``digest`` of its content and its ``size`` in pixels.

    Images with equal digests count as one image. ``focal`` is EXIF's focal length in pixels, 0 if
    unknown.
    """

    name: str
    digest: str
    size: Size
    focal: float = 0.0


@dataclass(frozen=True, eq=False)
class BatchPair:
    """Two images of a batch, and the matches of each unit, perhaps none, in full-image pixels.

    ``pair_fundamental`` is F (3, 3) from the pair's matches alone, or ``None``. ``tracks`` are the matches for the
    reconstruction; ``None`` means all matches.
    """

    image0: BatchImage
    image1: BatchImage
    by_unit: tuple[Matches, ...]
    pair_fundamental: Matrix3 | None = None
    tracks: Matches | None = None

    @property
    def matches(self) -> Matches:
        """The matches of all units."""
        return Matches.concatenate(self.by_unit)


@dataclass(frozen=True, eq=False)
class Edge:
    """All matches between two distinct images, whose indices in the graph are ``first < second``."""

    first: int
    second: int
    matches: Matches


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """Distinct images, and their edges, sorted by image indices. ``known`` has the user's cameras,
    by digest.
    """

    images: tuple[BatchImage, ...]
    edges: tuple[Edge, ...]
    known: Mapping[str, KnownCamera] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(image.name for image in self.images)

    @property
    def free(self) -> tuple[BatchImage, ...]:
        """The images without a camera of the user's."""
        return tuple(image for image in self.images if image.digest not in self.known)

    @property
    def matched(self) -> set[int]:
        """The numbers of the images with an edge."""
        return {image for edge in self.edges for image in (edge.first, edge.second)}

    @property
    def strong(self) -> "ViewGraph":
        """The graph with only the edges that have at least ``MIN_MATCHES`` matches."""
        edges = (edge for edge in self.edges if len(edge.matches) >= MIN_MATCHES)
        return replace(self, edges=tuple(edges))

    @classmethod
    def of_pairs(cls, pairs: Sequence[BatchPair]) -> "ViewGraph":
        """Return the graph of a batch's pairs.

        Pairs of the same two images, in either order, become one edge. A pair of an image with
        itself, and a pair without matches, make no edge.
        """
        # The first image with a content stands for all of them.
        images: dict[str, BatchImage] = {}
        for image in (image for pair in pairs for image in (pair.image0, pair.image1)):
            images.setdefault(image.digest, image)
        index = {digest: number for number, digest in enumerate(images)}
        parts: dict[tuple[int, int], list[Matches]] = {}
        for pair in pairs:
            first = index[pair.image0.digest]
            second = index[pair.image1.digest]
            tracks = pair.matches if pair.tracks is None else pair.tracks
            # Of either order, so that both become one edge
            if first > second:
                first, second = second, first
                tracks = Matches(tracks.points1, tracks.points0, tracks.scores)
            # Matches of an image with a copy of itself say nothing about cameras.
            if first < second and len(tracks):
                parts.setdefault((first, second), []).append(tracks)
        edges = tuple(Edge(*ends, Matches.concatenate(parts[ends])) for ends in sorted(parts))
        return cls(tuple(images.values()), edges)

    def with_intrinsics(self, rows: Rows) -> "ViewGraph":
        """Return the graph with the user's cameras of the images that the rows name."""
        cameras = dict(rows)
        named = [image for image in self.images if image.name in cameras]
        return replace(self, known={image.digest: cameras[image.name] for image in named})

    def components(self) -> tuple["ViewGraph", ...]:
        """Return the components connected by strong edges, ordered by first image."""
        from scipy.sparse import coo_array  # here: SciPy's modules take half a second
        from scipy.sparse.csgraph import connected_components

        # A few wrong matches must not join two scenes.
        strong = self.strong.edges
        firsts = np.array([edge.first for edge in strong], np.intp)
        seconds = np.array([edge.second for edge in strong], np.intp)
        count = len(self.images)
        adjacency = coo_array((np.ones(len(strong)), (firsts, seconds)), shape=(count, count))
        _, labels = connected_components(adjacency, directed=False)
        found = []
        # Images without a strong edge are in no component.
        for label in dict.fromkeys(labels[np.sort(firsts)].tolist()):
            # Images are renumbered within a component.
            members = np.flatnonzero(labels == label).tolist()
            index = {image: number for number, image in enumerate(members)}
            edges = tuple(
                Edge(index[edge.first], index[edge.second], edge.matches)
                for edge in strong
                if labels[edge.first] == label
            )
            images = tuple(self.images[image] for image in members)
            found.append(replace(self, images=images, edges=edges))
        return tuple(found)


def tracks_of(results: Sequence[UnitResult]) -> Matches:
    """Return the matches from units that make tracks, or all matches if these are few."""
    tracks = Matches.concatenate(result.matches for result in results if result.unit.tracks)
    if len(tracks) >= MIN_TRACK_MATCHES:
        return tracks
    # Any connection is better than none.
    return Matches.concatenate(each.matches for each in results)


def known_by_name(graph: ViewGraph) -> dict[str, KnownCamera]:
    """Return the user's cameras by image name."""
    return {
        image.name: graph.known[image.digest]
        for image in graph.images
        if image.digest in graph.known
    }


def supported(
    ends: Sequence[tuple[int, int]], inliers: Sequence[int], share: float
) -> list[bool]:
    """Return for each edge if it has at least ``share`` of the support of both of its images.

    ``ends`` are the indices of an edge's images, ``inliers`` its verified matches. Two sides of a temple, or two
    windows, have matches that agree with one fundamental matrix, but far fewer than the right edges of the same
    images. A few of these edges bend all cameras.
    """
    counts: dict[int, list[int]] = defaultdict(list)
    for images, count in zip(ends, inliers, strict=True):
        for image in images:
            counts[image].append(count)
    support = {
        image: sorted(of_image)[-SUPPORT_RANK:][0] for image, of_image in counts.items()
    }
    return [
        count >= share * max(support[image] for image in images)
        for images, count in zip(ends, inliers, strict=True)
    ]
