"""What LoMa and RoMa find in three pictures of a batch becomes the scene's keypoints."""

from functools import partial

import light_matchers
import numpy as np
import pytest
from light_matchers import SHIFT
from scipy.spatial import cKDTree

from mkpc_kaggle.geometry.coordinates import Points
from mkpc_kaggle.matchers.contract import Colour, Placement
from mkpc_kaggle.scene.batch import Edge
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.keypoints import SceneKeypoints, scene_keypoints

CELL = SceneConfig().cell


def edges_of(name: str) -> list[Edge]:
    """Of three pictures, each shifted against the one before."""
    matcher = light_matchers.MATCHERS[name](Placement())
    show = partial(light_matchers.picture, Colour.RGB, 0)
    encodings = matcher.encode([show(shift) for shift in (0, SHIFT // 2, SHIFT)])
    pairs = ((0, 1), (0, 2), (1, 2))
    matches = matcher.match(*([encodings[pair[side]] for pair in pairs] for side in (0, 1)))
    return [Edge(*pair, found) for pair, found in zip(pairs, matches, strict=True)]


def points_in(edges: list[Edge], image: int) -> Points:
    """All points of an image, of every pair."""
    of_first = [edge.matches.points0 for edge in edges if edge.first == image]
    return np.concatenate(of_first + [edge.matches.points1 for edge in edges if edge.second == image])


def assert_edges_are_of_the_matches(edges: list[Edge], scene: SceneKeypoints) -> None:
    """Every match between keypoints is one of the matcher's, but for the cell."""
    for edge, keypoints in zip(edges, scene.edges, strict=True):
        assert 0 < len(keypoints.index) <= len(edge.matches)
        rows = np.hstack(
            [scene.points[edge.first][keypoints.index[:, 0]], scene.points[edge.second][keypoints.index[:, 1]]]
        )
        found = cKDTree(np.hstack([edge.matches.points0, edge.matches.points1]))
        assert found.query(rows, p=np.inf)[0].max() <= 1.5 * CELL


def test_keypoints_of_loma_stay_as_they_are_and_are_followed_through_the_pictures() -> None:
    edges = edges_of("loma")
    scene = scene_keypoints(3, edges, CELL)
    assert_edges_are_of_the_matches(edges, scene)
    for image in range(3):
        given = np.unique(points_in(edges, image), axis=0)
        kept = scene.points[image]
        alone = cKDTree(given).query(given, k=2)[0][:, 1] > 2 * CELL
        assert alone.mean() > 0.5
        assert cKDTree(kept).query(given[alone])[0].max() < 1e-4
    middle = [set(scene.edges[0].index[:, 1].tolist()), set(scene.edges[2].index[:, 0].tolist())]
    assert len(middle[0] & middle[1]) > 20


@pytest.mark.parametrize("cell", [CELL, 4.0])
def test_matches_of_roma_are_merged_in_cells(cell: float) -> None:
    edges = edges_of("roma")
    scene = scene_keypoints(3, edges, cell)
    for image, points in enumerate(scene.points):
        assert len(points) < len(points_in(edges, image))
        assert np.isfinite(points).all()
    middle = [set(scene.edges[0].index[:, 1].tolist()), set(scene.edges[2].index[:, 0].tolist())]
    assert len(middle[0] & middle[1]) > (0 if cell == CELL else 20)
