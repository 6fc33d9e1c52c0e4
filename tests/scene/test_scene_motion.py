"""Cameras that turned without moving: named as such, with poses from other places as the contrast."""

from itertools import combinations

import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, batch_of, front, looking, synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene import assumptions, comparison, covariance, models
from mkpc_kaggle.scene.models import HARDLY_MOVED, Comparison, Reconstruction
from mkpc_kaggle.scene.motion import intrinsics, is_rotation
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

FOCAL = 840.0
IMAGES = 6


def panorama(step: float) -> list[BatchPair]:
    """Return the pairs of a camera that turns, and moves by ``step`` metres at 12 metres' distance."""
    world = front(np.random.default_rng(0), 800)
    cameras = []
    for number in range(IMAGES):
        centre = np.array([step * number, 0.0, -12.0])
        cameras.append(looking(centre, np.radians(6 * (number - 2.5)), FOCAL))
    ends = list(combinations(range(IMAGES), 2))
    return list(batch_of(np.random.default_rng(1), world, cameras, ends, 0.4, 0.1).pairs)


def reconstructed(pairs: list[BatchPair]) -> Reconstruction:
    (found,), _ = reconstruct_graph(ViewGraph.of_pairs(pairs), SceneConfig())
    return found


@pytest.mark.parametrize("step", [0.0, 0.05])
def test_a_camera_that_only_turned_is_the_reason_for_missing_or_doubtful_cameras(step):
    found = reconstructed(panorama(step))
    if found.models:
        assert not any(model.comparison.has_moved for model in found.models)
    else:
        assert found.failure == HARDLY_MOVED


@pytest.mark.parametrize(("max_sigma", "has_moved"), [(0.05, True), (1e-6, False)])
def test_a_part_of_a_large_model_shows_whether_its_cameras_are_certain(
    monkeypatch, max_sigma, has_moved
):
    # As of models with more than 200 images, which have no sigmas
    for module in (comparison, covariance, models):
        monkeypatch.setattr(module, "MAX_SIGMA_IMAGES", IMAGES - 1)
    # Most edges of a film are rotations, as those of a camera that turned.
    monkeypatch.setattr(assumptions, "hardly_moved", lambda _: True)
    monkeypatch.setattr(assumptions, "MAX_CENTRE_SIGMA", max_sigma)
    (model,) = reconstructed(list(synthetic_scene(IMAGES, points=400).pairs)).models
    assert len(model.images) == IMAGES
    assert model.centre_sigma is None
    assert model.comparison.has_moved is has_moved


def test_cameras_from_several_places_have_moved():
    scene = synthetic_scene(IMAGES, points=400)
    (model,) = reconstructed(list(scene.pairs)).models
    assert model.comparison == Comparison()


def homography(angle: float, step: float) -> np.ndarray:
    """Return H of a plane at distance 1, by a camera that turned (degrees) and moved sideways."""
    K = np.array([[FOCAL, 0, SIZE.width / 2], [0, FOCAL, SIZE.height / 2], [0, 0, 1]])
    a = np.radians(angle)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    # The plane z = 1: its normal is the optical axis.
    shift = np.outer([step, 0, 0], [0, 0, 1])
    return np.asarray(K @ (R + shift) @ np.linalg.inv(K))


@pytest.mark.parametrize(
    ("angle", "step", "expected"),
    [(5, 0, True), (30, 0, True), (10, 0.01, True), (-20, 0.5, False), (0, 0.5, False)],
)
def test_a_homography_is_that_of_a_rotation_only_if_the_camera_hardly_moved(angle, step, expected):
    K = intrinsics(1.3 * FOCAL, SIZE)  # a rough start
    H = 3.0 * homography(angle, step)  # of any scale
    points0 = np.random.default_rng(0).uniform(0, 600, (50, 2)).astype(np.float32)
    moved = np.column_stack([points0, np.ones(50)]) @ H.T
    points1 = (moved[:, :2] / moved[:, 2:]).astype(np.float32)
    assert is_rotation(H, points0, points1, K, K) == expected
    # The homography must explain the matches.
    assert not is_rotation(H, points0, points1 + 50, K, K)
    assert not is_rotation(np.full((3, 3), np.nan), points0, points1, K, K)
