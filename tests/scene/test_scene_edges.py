"""Edges with too few inliers next to the other edges of their images."""

import pytest

from mkpc_kaggle.scene.view_graph import supported

# A ring of six images: neighbours share many matches, opposite sides look alike
RING = {(0, 1): 400, (1, 2): 500, (2, 3): 400, (3, 4): 600, (4, 5): 500, (0, 5): 400}
SECOND = {(0, 2): 150, (1, 3): 160, (2, 4): 140, (3, 5): 150, (0, 4): 150, (1, 5): 160}
OPPOSITE = {(0, 3): 10, (1, 4): 15, (2, 5): 12}


def kept(edges: dict[tuple[int, int], int], share: float) -> set[tuple[int, int]]:
    found = supported(list(edges), list(edges.values()), share)
    return {ends for ends, is_supported in zip(edges, found, strict=True) if is_supported}


def test_edges_between_opposite_sides_have_too_little_support():
    edges = {**RING, **OPPOSITE, **SECOND}
    assert kept(edges, 0.1) == {**RING, **SECOND}.keys()


@pytest.mark.parametrize("copies", [20_000, 400])
def test_one_strong_edge_sets_no_standard_for_the_others(copies):
    """Two copies of a photograph share all their matches."""
    edges = {**RING, **SECOND, (0, 1): copies}
    assert kept(edges, 0.1) == edges.keys()
