"""Which F a pair gets, which cameras are rejected, and the settings' keys."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.recipe import CameraModel, SceneConfig
from mkpc_kaggle.scene.choose import Choice, Reason, choose
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel, filter_models
from mkpc_kaggle.scene.view_graph import BatchImage


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(4, points=600, outliers=0.3)


def model(cameras: dict[str, Camera], points: int = 100) -> SfmModel:
    registered = (
        RegisteredImage(BatchImage(name, f"digest of {name}", SIZE), camera, points)
        for name, camera in cameras.items()
    )
    return SfmModel(tuple(registered), np.zeros((points, 3)), 0.5)


def choice(models: list[SfmModel], scene: SyntheticScene, **changes: object) -> Choice:
    """What the first pair gets."""
    found = [{image.image.digest: image for image in model.images} for model in models]
    return choose(replace(scene.pairs[0], **changes), found)


def test_the_scenes_fundamental_is_that_of_the_cameras(scene):
    chosen = choice([model(scene.cameras)], scene)
    assert chosen.from_scene
    assert chosen.reason is Reason.SCENE
    np.testing.assert_allclose(chosen.F, scene.true_fundamental(scene.pairs[0]))


def test_an_image_without_a_camera_leaves_the_pair_its_own(scene):
    rest = {name: camera for name, camera in scene.cameras.items() if name != "0000"}
    assert choice([model(rest)], scene).reason is Reason.UNREGISTERED
    assert choice([], scene).reason is Reason.UNREGISTERED


def test_cameras_of_two_models_make_no_fundamental(scene):
    apart = [model({name: scene.cameras[name]}) for name in ("0000", "0001")]
    assert choice(apart, scene).reason is Reason.APART


def test_a_picture_and_itself_have_no_fundamental(scene):
    assert choice([model(scene.cameras)], scene, image1=scene.images[0]).reason is Reason.SAME_IMAGE


def test_two_cameras_at_one_point_have_no_fundamental(scene):
    cameras = scene.cameras | {"0001": scene.cameras["0000"]}
    assert choice([model(cameras)], scene).reason is Reason.SAME_CENTRE


def test_a_wrong_camera_is_contradicted_by_the_pairs_matches(scene):
    camera, tilt = scene.cameras["0001"], cv2.Rodrigues(np.array([np.radians(15), 0, 0]))[0]
    wrong = scene.cameras | {"0001": Camera(camera.K, tilt @ camera.R, tilt @ camera.t)}
    own = scene.true_fundamental(scene.pairs[0])
    assert choice([model(wrong)], scene, pair_fundamental=own).reason is Reason.CONTRADICTION
    assert choice([model(wrong)], scene).from_scene  # without an F of its own, nothing contradicts


def with_camera(scene: SyntheticScene, **changes: object) -> SfmModel:
    cameras = model(scene.cameras)
    return replace(cameras, images=(replace(cameras.images[0], **changes), *cameras.images[1:]))


@pytest.mark.parametrize("focal", [-900.0, 0.0, 1e5, np.nan])
def test_an_absurd_focal_length_is_left_out(scene, focal):
    bad = replace(scene.cameras["0000"], K=np.diag([focal, focal, 1.0]))
    (kept,) = filter_models((with_camera(scene, camera=bad),))
    assert [found.image.name for found in kept.images] == ["0001", "0002", "0003"]


def test_a_model_that_is_too_small_is_left_out(scene):
    small = model({name: scene.cameras[name] for name in ("0000", "0001")})
    assert [len(each.images) for each in filter_models((small, model(scene.cameras)))] == [4]


def test_settings_come_from_a_table():
    config = from_table(SceneConfig, {"camera_model": "SIMPLE_RADIAL", "pairs_per_image": 2}, "[scene]")
    assert (config.camera_model, config.pairs_per_image) == (CameraModel.RADIAL, 2.0)
    with pytest.raises(UserError, match=r"unknown key 'cells'.*camera_model"):
        from_table(SceneConfig, {"cells": 1.0}, "[scene]")
    with pytest.raises(UserError, match=r"\[scene\]: shared_intrinsics must be in"):
        from_table(SceneConfig, {"shared_intrinsics": -1}, "[scene]")
