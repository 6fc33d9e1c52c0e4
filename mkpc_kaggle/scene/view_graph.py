"""The view graph of a batch: its distinct images, and the matches between each two of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult

MIN_MATCHES = 15  # an edge with fewer connects nothing; also the inliers that a verified edge needs
MIN_TRACK_MATCHES = 50  # a pair with fewer matches from units that make tracks uses those of all its units


@dataclass(frozen=True)
class BatchImage:
    """An image of a batch: its ``name``, the ``digest`` of its content, its ``size`` in pixels.

    Two names with one digest are one image. ``focal`` is the focal length in pixels by its EXIF, 0 if unknown.
    """

    name: str
    digest: str
    size: Size
    focal: float = 0.0


@dataclass(frozen=True, eq=False)
class BatchPair:
    """Two images of a batch and their matches in full-image pixels, which may be empty.

    ``pair_fundamental`` is the F, (3, 3), that the pair's matches alone gave, or ``None``. ``tracks`` are the
    matches that the scene is made of; ``None``: all matches.
    """

    image0: BatchImage
    image1: BatchImage
    matches: Matches
    pair_fundamental: Matrix3 | None = None
    tracks: Matches | None = None


@dataclass(frozen=True, eq=False)
class Edge:
    """All matches between two distinct images, given by their indices in a list of images, ``first < second``."""

    first: int
    second: int
    matches: Matches


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """Distinct images, and the edges between them in order of their two ends."""

    images: tuple[BatchImage, ...]
    edges: tuple[Edge, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(image.name for image in self.images)

    @property
    def strong(self) -> "ViewGraph":
        """The same images, and the edges with at least ``MIN_MATCHES`` matches: fewer connect nothing."""
        return ViewGraph(self.images, tuple(edge for edge in self.edges if len(edge.matches) >= MIN_MATCHES))

    @classmethod
    def of_pairs(cls, pairs: Sequence[BatchPair]) -> "ViewGraph":
        """The graph of a batch's pairs.

        Pairs of the same two images become one edge, whatever their order. A pair of an image with itself and a
        pair without matches make no edge.
        """
        images: dict[str, BatchImage] = {}
        for image in (image for pair in pairs for image in (pair.image0, pair.image1)):
            images.setdefault(image.digest, image)
        index = {digest: number for number, digest in enumerate(images)}
        parts: dict[tuple[int, int], list[Matches]] = {}
        for pair in pairs:
            first, second = index[pair.image0.digest], index[pair.image1.digest]
            tracks = pair.matches if pair.tracks is None else pair.tracks
            if first > second:
                first, second = second, first
                tracks = Matches(tracks.points1, tracks.points0, tracks.scores)
            if first < second and len(tracks):
                parts.setdefault((first, second), []).append(tracks)
        edges = tuple(Edge(*ends, Matches.concatenate(parts[ends])) for ends in sorted(parts))
        return cls(tuple(images.values()), edges)

    def components(self) -> tuple["ViewGraph", ...]:
        """The connected components that have a strong edge, by their first images; weak edges are in none."""
        strong = self.strong.edges
        ends = np.array([(edge.first, edge.second) for edge in strong], np.intp).reshape(-1, 2)
        shape = (len(self.images), len(self.images))
        adjacency = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=shape)
        _, labels = connected_components(adjacency, directed=False)
        found = []
        for label in dict.fromkeys(labels[np.sort(ends[:, 0])].tolist()):
            members = np.flatnonzero(labels == label).tolist()
            index = {image: number for number, image in enumerate(members)}
            inside = [edge for edge in strong if labels[edge.first] == label]
            edges = tuple(Edge(index[edge.first], index[edge.second], edge.matches) for edge in inside)
            found.append(ViewGraph(tuple(self.images[image] for image in members), edges))
        return tuple(found)


def tracks_of(results: Sequence[UnitResult]) -> Matches:
    """Return the matches that a scene is made of: of units that make tracks, or all if those are few."""
    tracks = Matches.concatenate(result.matches for result in results if result.unit.tracks)
    return tracks if len(tracks) >= MIN_TRACK_MATCHES else Matches.concatenate(each.matches for each in results)
