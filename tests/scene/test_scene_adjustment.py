"""The last bundle adjustment of a model: it moves points of two views, and removes wrong ones."""

from typing import Any

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.adjustment import (
    MAX_TWO_VIEW_ERROR_PX,
    adjust,
    remove_uncertain_points,
    two_view_points,
)
from mkpc_kaggle.scene.sfm import reconstruct_batch


@pytest.fixture
def model() -> Any:
    """Return pycolmap's model of six images, in which two images see every second point."""
    scene = synthetic_scene(6, points=500)
    (found,) = reconstruct_batch(scene.pairs, SceneConfig()).reconstructions
    model = found.models[0].colmap
    observations = pycolmap.ObservationManager(model)
    for number in sorted(model.points3D)[::2]:
        # Copied, since a deletion changes the track
        track = [
            (each.image_id, each.point2D_idx)
            for each in model.points3D[number].track.elements
        ]
        for image, keypoint in sorted(track)[1:-1]:
            observations.delete_observation(image, keypoint)
    return model


def move(model: Any, number: int, by: np.ndarray) -> None:
    model.points3D[number].xyz = model.points3D[number].xyz + by


def mean_error(model: Any, numbers: set[int]) -> float:
    model.update_point_3d_errors()
    return float(np.mean([model.points3D[number].error for number in numbers]))


def test_points_that_only_two_images_see_are_adjusted_too(model):
    points = two_view_points(model)
    rng = np.random.default_rng(0)
    for number in sorted(points):
        move(model, number, rng.normal(0, 0.01, 3))
    before = mean_error(model, points)
    assert before < MAX_TWO_VIEW_ERROR_PX / 2, "moved by about a pixel"
    adjust(model, {})
    kept = points & set(model.points3D)
    assert len(kept) > 0.9 * len(points)
    assert mean_error(model, kept) < before / 2


def test_a_wrong_point_of_two_views_is_removed_and_one_of_more_views_is_not(model):
    remove_uncertain_points(model)
    points = two_view_points(model)
    wrong = min(points)
    more_views = min(set(model.points3D) - points)
    for number in (wrong, more_views):
        # A fraction of the cameras' distance, which is many pixels
        move(model, number, np.array([0.0, 0.0, 5.0]))
    remove_uncertain_points(model)
    assert points - two_view_points(model) == {wrong}
    assert more_views in model.points3D
