"""Which images of a batch are connected: the scenes that can be reconstructed at all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mkpc_kaggle.scene.batch import Edge


@dataclass(frozen=True, eq=False)
class Component:
    """Connected images, by their places in a list of images, ascending, and all edges between them.

    The ends of ``edges`` are places in ``images``.
    """

    images: tuple[int, ...]
    edges: tuple[Edge, ...]


def components(image_count: int, edges: Sequence[Edge], least_matches: int) -> tuple[Component, ...]:
    """The connected components that have an edge, by their first images.

    An edge with fewer matches than ``least_matches`` connects nothing, and is in no component.
    """
    strong = [edge for edge in edges if len(edge.matches) >= least_matches]
    ends = np.array([(edge.first, edge.second) for edge in strong], np.intp).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(image_count, image_count))
    _, labels = connected_components(graph, directed=False)
    found = []
    for label in dict.fromkeys(labels[np.sort(ends[:, 0])].tolist()):
        images = np.flatnonzero(labels == label).tolist()
        place = {image: number for number, image in enumerate(images)}
        inside = [edge for edge in strong if labels[edge.first] == label]
        found.append(
            Component(
                tuple(images),
                tuple(Edge(place[edge.first], place[edge.second], edge.matches) for edge in inside),
            )
        )
    return tuple(found)
