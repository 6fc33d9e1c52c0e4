"""Points of all pairs of an image become keypoints; matches are between keypoints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.batch import Batch, BatchImage, BatchPair, Edge, edges_of, matchers_of
from mkpc_kaggle.scene.graph import components
from mkpc_kaggle.scene.keypoints import merge_points, one_to_one, scene_keypoints

SIZE = Size(100, 80)


def matches(*rows: tuple[float, float, float, float]) -> Matches:
    table = np.array(rows, np.float32).reshape(-1, 4)
    return Matches(table[:, :2], table[:, 2:], np.ones(len(table)))


def batch(names: str, *pairs: tuple[str, str, Matches]) -> Batch:
    """One-letter images, of which the small letter has the content of the capital one."""
    return Batch(tuple(BatchImage(n, n.upper(), SIZE) for n in names), tuple(BatchPair(*pair) for pair in pairs))


@given(arrays(np.float32, st.tuples(st.integers(0, 60), st.just(2)), elements=st.floats(-5, 5, width=32)))
def test_a_keypoint_is_the_mean_of_its_points_and_near_each_of_them(points: np.ndarray) -> None:
    keypoints, place = merge_points(points, 0.75)
    assert len(place) == len(points)
    assert set(place.tolist()) == set(range(len(keypoints)))
    for number, keypoint in enumerate(keypoints):
        np.testing.assert_allclose(keypoint, points[place == number].astype(float).mean(axis=0), atol=1e-5)
    if len(points):  # two cells, shifted against each other, are 1.5 cells wide at most
        assert np.abs(points - keypoints[place]).max() <= 1.5 * 0.75 + 1e-5


def test_points_on_both_sides_of_a_cells_border_are_one_keypoint() -> None:
    keypoints, place = merge_points(np.array([[0.74, 1.49], [0.76, 1.51], [9, 9]], np.float32), 0.75)
    assert len(keypoints) == 2
    assert place[0] == place[1] != place[2]
    np.testing.assert_allclose(keypoints[place[0]], [0.75, 1.5], atol=1e-6)


def test_points_further_apart_than_three_cells_are_never_merged() -> None:
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(9)), axis=-1).reshape(-1, 2).astype(np.float32) * 3.1
    keypoints, _ = merge_points(grid, 1.0)
    assert len(keypoints) == len(grid)


def test_keypoints_do_not_depend_on_the_order_of_the_points() -> None:
    points = np.random.default_rng(0).uniform(0, 40, (500, 2)).astype(np.float32)
    order = np.random.default_rng(1).permutation(500)
    keypoints, place = merge_points(points, 0.75)
    again, moved = merge_points(points[order], 0.75)
    np.testing.assert_allclose(again, keypoints, atol=1e-5)
    np.testing.assert_array_equal(moved, place[order])


def test_a_match_that_two_matchers_found_is_one_and_outvotes_another() -> None:
    edge = Edge(0, 1, matches((10, 10, 60, 60), (10, 10, 20, 20), (10.1, 10, 20, 20.1)))
    keypoints = scene_keypoints(2, [edge], 0.75)
    ((index,),) = [edge.index.tolist() for edge in keypoints.edges]
    np.testing.assert_allclose(keypoints.points[1][index[1]], [20, 20.05], atol=1e-5)


def test_a_keypoint_is_matched_once_and_to_what_was_found_most_often() -> None:
    index = np.array([[0, 5], [0, 6], [0, 6], [1, 6], [2, 7], [2, 8]])
    assert one_to_one(index).tolist() == [[0, 6], [2, 7]]
    assert one_to_one(np.zeros((0, 2), np.intp)).shape == (0, 2)


def test_a_point_seen_in_two_pairs_is_one_keypoint() -> None:
    edges = [
        Edge(0, 1, matches((10, 10, 20, 20), (30, 30, 40, 40))),
        Edge(0, 2, matches((10.1, 9.9, 50, 50))),
        Edge(1, 2, matches((20.05, 20, 50.1, 50))),
    ]
    keypoints = scene_keypoints(3, edges, 0.75)
    assert [len(points) for points in keypoints.points] == [2, 2, 1]
    tracks = {(edge.first, edge.second): edge.index.tolist() for edge in keypoints.edges}
    (a, b), (a2, c) = tracks[0, 1][0], tracks[0, 2][0]
    assert a == a2
    assert tracks[1, 2] == [[b, c]]
    np.testing.assert_allclose(keypoints.points[0][a], [10.05, 9.95], atol=1e-5)


def test_an_image_without_matches_has_no_keypoints() -> None:
    keypoints = scene_keypoints(3, [Edge(0, 2, matches((1, 1, 2, 2)))], 0.75)
    assert [points.shape for points in keypoints.points] == [(1, 2), (0, 2), (1, 2)]


def test_the_same_picture_under_two_names_is_one_image() -> None:
    edges = edges_of(
        batch(
            "ABa",
            ("A", "B", matches((1, 1, 2, 2))),
            ("B", "a", matches((4, 4, 3, 3))),
            ("A", "a", matches((1,) * 4)),
        )
    )
    assert [(edge.first, edge.second) for edge in edges] == [(0, 1)]
    assert edges[0].matches.points0.tolist() == [[1, 1], [3, 3]]
    assert edges[0].matches.points1.tolist() == [[2, 2], [4, 4]]


def test_a_scene_is_made_of_a_pairs_tracks_where_it_has_some() -> None:
    images = (BatchImage("A", "A", SIZE), BatchImage("B", "B", SIZE))
    tracks = {"fine": matches((2, 2, 3, 3)), "finer": matches((4, 4, 5, 5))}
    pair = BatchPair("B", "A", matches((1,) * 4, (2, 2, 3, 3), (4, 4, 5, 5)), tracks=tracks)
    of_scene = Batch(images, (pair,))
    assert matchers_of(of_scene) == ("fine", "finer")
    assert [len(edge.matches) for edge in edges_of(of_scene)] == [2]
    (edge,) = edges_of(of_scene, "finer")
    assert edge.matches.points0.tolist() == [[5, 5]]
    assert edge.matches.points1.tolist() == [[4, 4]]


def test_pairs_without_matches_are_no_edges() -> None:
    assert edges_of(batch("AB", ("A", "B", Matches.empty()))) == ()


@pytest.mark.parametrize("names", ["A", "AA"])
def test_a_batch_of_unknown_or_repeated_images_is_refused(names: str) -> None:
    with pytest.raises(ValueError, match=r"one name|lacks"):
        batch(names, ("A", "B", Matches.empty()))


def test_components_are_connected_by_pairs_with_enough_matches() -> None:
    def edge(first: int, second: int, count: int) -> Edge:
        return Edge(first, second, Matches(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count)))

    edges = [edge(1, 3, 20), edge(1, 4, 20), edge(3, 5, 4), edge(5, 6, 15)]
    found = components(8, edges, 15)
    assert [component.images for component in found] == [(1, 3, 4), (5, 6)]
    assert [[(e.first, e.second) for e in c.edges] for c in found] == [[(0, 1), (0, 2)], [(0, 1)]]
    assert components(8, [], 15) == ()
    assert components(0, [], 15) == ()
