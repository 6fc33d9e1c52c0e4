"""The view graph of a batch, and its keypoints: points of all pairs of an image, merged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.keypoints import merge_points, one_to_one, scene_keypoints
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, Edge, ViewGraph, tracks_of

SIZE = Size(100, 80)


def matches(*rows: tuple[float, float, float, float]) -> Matches:
    table = np.array(rows, np.float32).reshape(-1, 4)
    return Matches(table[:, :2], table[:, 2:], np.ones(len(table)))


def image(name: str) -> BatchImage:
    """A small letter has the content of its capital letter."""
    return BatchImage(name, name.upper(), SIZE)


def pair(names: str, found: Matches) -> BatchPair:
    return BatchPair(image(names[0]), image(names[1]), (found,))


SHAPES = st.tuples(st.integers(0, 60), st.just(2))
COORDINATES = st.floats(-5, 5, width=32)
CELL_PX = 0.75


@settings(max_examples=40)
@given(arrays(np.float32, SHAPES, elements=COORDINATES))
def test_a_keypoint_is_the_mean_of_its_points_and_near_each_of_them(points):
    keypoints, place = merge_points(points, CELL_PX)
    assert len(place) == len(points)
    assert set(place.tolist()) == set(range(len(keypoints)))
    for number, keypoint in enumerate(keypoints):
        merged = points[place == number].astype(float)
        np.testing.assert_allclose(keypoint, merged.mean(axis=0), atol=1e-5)
    # Two cells, shifted against each other, are 1.5 cells wide at most.
    distances = np.abs(points - keypoints[place])
    assert distances.max(initial=0) <= 1.5 * CELL_PX + 1e-5


@settings(max_examples=40)
@given(arrays(np.intp, SHAPES, elements=st.integers(0, 12)))
def test_of_conflicting_matches_the_more_frequent_wins_and_then_the_earlier(index):
    rows = [tuple(row) for row in index.tolist()]
    wanted = []
    for row in sorted(set(rows), key=lambda row: (-rows.count(row), rows.index(row))):
        if all(row[0] != i and row[1] != j for i, j in wanted):
            wanted.append(row)
    assert one_to_one(index).tolist() == [list(row) for row in sorted(wanted)]


def test_a_point_seen_in_two_pairs_is_one_keypoint():
    edges = (
        Edge(0, 1, matches((10.45, 10, 20, 20), (30, 30, 40, 40))),
        Edge(0, 2, matches((10.55, 9.9, 50, 50))),
        Edge(1, 2, matches((20.05, 20, 50.1, 50))),
    )
    graph = ViewGraph(tuple(map(image, "ABC")), edges)
    keypoints, found = scene_keypoints(graph)
    assert list(map(len, keypoints)) == [2, 2, 1]
    first, second, third = (index.tolist() for index in found)
    # Their points lie on both sides of 10.5, the border of a cell.
    a, b = first[0]
    a2, c = second[0]
    assert a == a2
    assert third == [[b, c]]
    np.testing.assert_allclose(keypoints[0][a], [10.5, 9.95], atol=1e-5)


def test_the_same_picture_under_two_names_is_one_image():
    # A and a are one image, so the second pair is the first one backwards.
    there = matches((1, 1, 2, 2))
    back = matches((4, 4, 3, 3))
    same = matches((1,) * 4)
    pairs = [pair("AB", there), pair("Ba", back), pair("Aa", same)]
    graph = ViewGraph.of_pairs(pairs)
    assert [found.name for found in graph.images] == ["A", "B"]
    (edge,) = graph.edges
    assert (edge.first, edge.second) == (0, 1)
    assert edge.matches.points0.tolist() == [[1, 1], [3, 3]]
    assert edge.matches.points1.tolist() == [[2, 2], [4, 4]]


def test_a_graph_is_made_of_a_pairs_tracks_where_it_has_some():
    every = matches((1,) * 4, (2, 2, 3, 3), (4, 4, 5, 5))
    tracks = matches((4, 4, 5, 5))
    with_tracks = BatchPair(image("B"), image("A"), (every,), tracks=tracks)
    pairs = [pair("AB", Matches.empty()), with_tracks]
    # The images of the graph begin with A, so the pair B, A is turned round.
    (edge,) = ViewGraph.of_pairs(pairs).edges
    assert edge.matches.points0.tolist() == [[5, 5]]
    assert edge.matches.points1.tolist() == [[4, 4]]


def test_components_are_connected_by_pairs_with_enough_matches():
    def edge(first: int, second: int, count: int) -> Edge:
        points = np.zeros((count, 2))
        return Edge(first, second, Matches(points, points, np.zeros(count)))

    # Four matches are too few to connect 3 and 5; 15 are just enough.
    edges = (
        edge(1, 3, 20),
        edge(1, 4, 20),
        edge(3, 5, 4),
        edge(5, 6, 15),
    )
    images = tuple(image(name) for name in "ABCDEFGH")
    large, small = ViewGraph(images, edges).components()
    assert [found.name for found in large.images] == ["B", "D", "E"]
    assert [found.name for found in small.images] == ["F", "G"]
    # Images are renumbered within a component.
    assert [(found.first, found.second) for found in large.edges] == [(0, 1), (0, 2)]
    assert [(found.first, found.second) for found in small.edges] == [(0, 1)]
    assert ViewGraph((image("A"),), ()).components() == ()
    assert ViewGraph((), ()).components() == ()


def results_of(*counts: int) -> list[UnitResult]:
    """Results with these numbers of matches: of a unit whose matches make no tracks, and of a unit
    whose matches do.
    """
    units = (Unit(1, "coarse", 640, tracks=False), Unit(1, "fine", 640))
    results = []
    for unit, count in zip(units, counts, strict=True):
        points = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
        results.append(UnitResult(unit, Matches(points, points, np.zeros(count))))
    return results


@pytest.mark.parametrize(("fine", "used"), [(50, 50), (49, 79), (0, 30)])
def test_matches_without_tracks_are_for_pairs_with_few_others(fine, used):
    assert len(tracks_of(results_of(30, fine))) == used
