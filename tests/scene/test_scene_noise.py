"""Images whose keypoints are less exact move the cameras of the others less."""

from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic_scene import SyntheticScene, registered_images, synthetic_scene
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene import colmap, noise
from mkpc_kaggle.scene.reconstruct import Solution, reconstruct_batch
from mkpc_kaggle.scene.reconstruction import SfmModel

SHARP, BLURRED = 5, 3
NOISES = [0.1] * SHARP + [0.6] * BLURRED
OWN_CAMERAS = SceneConfig(cameras=CameraSharing.IMAGE)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(len(NOISES), points=500, noise=NOISES, seed=2)


def as_the_mapper_left_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap, "adjust_by_noise", lambda *_: None)


def focal_error(solution: Solution, scene: SyntheticScene, images: slice = slice(SHARP)) -> float:
    """Of these images, as a share, in the mean."""
    found = registered_images(solution)
    return float(
        np.mean([abs(found[i.digest].focal / scene.cameras[i.name].K[0, 0] - 1) for i in scene.images[images]])
    )


def model_of(solution: Solution) -> SfmModel:
    ((model,),) = (found.models for found in solution.reconstructions)
    return model


def test_blurred_images_no_longer_move_the_focal_lengths_of_sharp_ones(scene, monkeypatch):
    adjusted = focal_error(reconstruct_batch(scene.pairs, OWN_CAMERAS), scene)
    as_the_mapper_left_it(monkeypatch)
    assert adjusted < 0.5 * focal_error(reconstruct_batch(scene.pairs, OWN_CAMERAS), scene)


def test_the_noise_of_each_image_is_found(scene):
    found = model_of(reconstruct_batch(scene.pairs, OWN_CAMERAS)).colmap
    known = [noise.ScaledCamera([image]).noise(found.points3D) for _, image in sorted(found.images.items())]
    assert known == pytest.approx(NOISES, abs=0.1)


def test_keypoints_and_centres_are_given_back_to_the_bit(scene, monkeypatch):
    def keypoints(model: SfmModel) -> dict[str, Any]:
        images = model.colmap.images.values()
        return {image.name: [tuple(point.xy) for point in image.points2D] for image in images}

    adjusted = model_of(reconstruct_batch(scene.pairs, OWN_CAMERAS))
    as_the_mapper_left_it(monkeypatch)
    before = model_of(reconstruct_batch(scene.pairs, OWN_CAMERAS))
    assert keypoints(adjusted) == keypoints(before)
    for found, former in zip(adjusted.images, before.images, strict=True):
        assert found.camera.K[:2, 2].tolist() == former.camera.K[:2, 2].tolist()
        assert found.focal != former.focal


def test_a_few_images_that_share_a_camera_have_one_noise(monkeypatch):
    """Six sharp images of one camera among five blurred ones of other cameras."""
    focals, noises = [900.0] * 6 + [700.0, 1050.0, 1200.0, 800.0, 990.0], [0.1] * 6 + [0.6] * 5
    mixed = [0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5]
    group = synthetic_scene(
        11, points=500, noise=[noises[n] for n in mixed], focals=[focals[n] for n in mixed], seed=4
    )
    solution = reconstruct_batch(group.pairs, SceneConfig())
    assert len({image.camera.K[0, 0] for image in model_of(solution).images}) == 6
    as_the_mapper_left_it(monkeypatch)
    before = reconstruct_batch(group.pairs, SceneConfig())
    assert focal_error(solution, group, slice(None)) < 0.6 * focal_error(before, group, slice(None))


def test_images_that_all_share_a_camera_keep_what_the_mapper_found(scene, monkeypatch):
    one = SceneConfig(cameras=CameraSharing.FOLDER)
    cameras = [found.camera.K.tolist() for found in model_of(reconstruct_batch(scene.pairs, one)).images]
    as_the_mapper_left_it(monkeypatch)
    assert cameras == [found.camera.K.tolist() for found in model_of(reconstruct_batch(scene.pairs, one)).images]


def test_what_pycolmap_raises_leaves_what_the_mapper_found(scene, monkeypatch):
    def broken(*_: object) -> None:
        raise RuntimeError("no memory")

    monkeypatch.setattr(colmap, "adjust_by_noise", broken)
    assert all(choice.from_scene for choice in reconstruct_batch(scene.pairs, OWN_CAMERAS).choices)


def test_an_image_that_sees_little_counts_as_much_as_the_median_image(scene, monkeypatch):
    monkeypatch.setattr(noise, "MIN_OBSERVATIONS", 10_000)
    solution = reconstruct_batch(scene.pairs, OWN_CAMERAS)
    assert all(choice.from_scene for choice in solution.choices)


def test_keypoints_without_noise_are_no_division_by_nothing():
    exact = synthetic_scene(5, points=300, noise=0.0, outliers=0.0)
    assert focal_error(reconstruct_batch(exact.pairs, OWN_CAMERAS), exact) < 1e-3
