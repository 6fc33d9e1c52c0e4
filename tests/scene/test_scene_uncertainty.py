"""The errors to expect of cameras: true on scenes with known cameras, in any world, larger for few
points.
"""

from functools import partial

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.geometry.intrinsics import displacement_of
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene import uncertainty
from mkpc_kaggle.scene.comparison import log_ratio
from mkpc_kaggle.scene.covariance import covariance_of, seeing_images
from mkpc_kaggle.scene.models import SfmModel, lens_of
from mkpc_kaggle.scene.sfm import reconstruct_batch
from mkpc_kaggle.scene.uncertainty import PRINCIPAL_POINT_SHARE, camera_sigmas


def model_of(
    scene: SyntheticScene, camera_model: CameraModel = CameraModel.SIMPLE_PINHOLE
) -> SfmModel:
    # An intrinsic matrix for each image, so that each focal length has its own error.
    config = SceneConfig(cameras=CameraSharing.IMAGE, camera_model=camera_model)
    solution = reconstruct_batch(scene.pairs, config)
    (found,) = solution.reconstructions
    (model,) = found.models
    return model


def centred(points: np.ndarray) -> np.ndarray:
    return points - points.mean(axis=0)


def errors_over_sigmas(model: SfmModel, scene: SyntheticScene) -> np.ndarray:
    """Return each image's errors of rotation, centre and focal length over their sigmas, (N, 3).

    A similarity of the world is no error: the true cameras are first moved onto the found ones.
    """
    true_cameras = [scene.cameras[found.image.name] for found in model.images]
    R = np.array([found.camera.R for found in model.images])
    true_R = np.array([camera.R for camera in true_cameras])
    # From the true to the found world, by the mean over all cameras.
    each_world = R.transpose(0, 2, 1) @ true_R
    world = Rotation.from_matrix(each_world).mean().as_matrix()
    turns = Rotation.from_matrix(R @ world @ true_R.transpose(0, 2, 1))
    rotation_errors = np.degrees(turns.magnitude())

    centres = centred(np.array([found.camera.centre for found in model.images]))
    true_centres = centred(np.array([camera.centre for camera in true_cameras])) @ world.T
    # The scale of least squares.
    scale = (centres * true_centres).sum() / (true_centres**2).sum()
    distances = np.linalg.norm(centres - scale * true_centres, axis=1)
    # Sigmas of centres are relative to the root mean square distance of the cameras.
    size = np.sqrt((centres**2).sum(axis=1).mean())
    centre_errors = distances / size

    focals = np.array([found.focal for found in model.images])
    true_focals = np.array([camera.K[0, 0] for camera in true_cameras])
    focal_errors = np.abs(100 * (focals / true_focals - 1))  # percent

    errors = np.column_stack([rotation_errors, centre_errors, focal_errors])
    sigmas = [found.sigmas for found in model.images]
    return errors / sigmas


@pytest.mark.parametrize("share", [0.001, PRINCIPAL_POINT_SHARE])
def test_errors_are_about_as_large_as_expected(share, monkeypatch):
    """90 % of normal errors are below 1.645 sigma; of three dimensions, below 1.44 to 1.645.

    With the smaller share, most of the errors are by the noise of keypoints.
    """
    monkeypatch.setattr(uncertainty, "PRINCIPAL_POINT_SHARE", share)
    # 32 cameras; the bounds leave room for their number.
    ratios = []
    for seed in range(4):
        scene = synthetic_scene(8, points=400, seed=seed, principal_point_share=share)
        model = model_of(scene)
        ratios.append(errors_over_sigmas(model, scene))
    # One row a camera; columns: rotation, centre, focal length.
    table = np.concatenate(ratios)
    share_below = (table < 1.645).mean(axis=0)
    assert (share_below > 0.7).all()
    root_mean_square = np.sqrt((table**2).mean(axis=0))
    # Wrong by a factor of 1.5 at most, in either direction.
    assert (np.abs(np.log(root_mean_square)) < np.log(1.5)).all()


@pytest.mark.parametrize(
    ("camera_model", "quantity"),
    [
        (CameraModel.SIMPLE_RADIAL, partial(displacement_of, size=SIZE)),
        (CameraModel.PINHOLE, log_ratio),
    ],
)
def test_errors_of_distortion_and_of_the_ratio_are_about_as_large_as_expected(
    camera_model, quantity
):
    """True pinholes have square pixels and no distortion, so both quantities are 0."""
    ratios = []
    for seed in range(4):
        scene = synthetic_scene(8, points=400, seed=seed)
        model = model_of(scene, camera_model)
        covariance = covariance_of(model.colmap, {}, 0.0)
        assert covariance is not None
        for image in covariance.images:
            lens = lens_of(image.camera)
            assert lens is not None
            sigma = np.sqrt(covariance.variance(image.camera, quantity))
            ratios.append(quantity(lens) / sigma)
    assert len(ratios) == 32
    root_mean_square = np.sqrt(np.mean(np.square(ratios)))
    # Wrong by a factor of 1.5 at most, in either direction.
    assert abs(np.log(root_mean_square)) < np.log(1.5)


def test_an_error_of_the_principal_point_is_expected_of_many_exact_points():
    """Without noise, the rest of the error is the principal points' alone."""
    model = model_of(synthetic_scene(6, points=3000, noise=0.01))
    exact = covariance_of(model.colmap, {}, 0.0)
    sigmas = camera_sigmas(model.colmap)
    assert exact is not None
    camera = seeing_images(model.colmap)[0].camera
    noise_alone = 100 * np.sqrt(exact.focal_variance(camera))
    assert sigmas[model.images[0].image.name].focal > 2 * noise_alone


# The last one as of coordinates such as UTM's
@pytest.mark.parametrize("shift", [(5.0, -2, 1), (5e5, 5e6, 100)])
def test_they_are_the_same_in_another_world(shift):
    model = model_of(synthetic_scene(6, points=400))
    before = camera_sigmas(model.colmap)
    # Another scale, orientation and origin.
    turn = pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1]))
    similarity = pycolmap.Sim3d(3.0, turn, np.array(shift))
    moved = pycolmap.Reconstruction(model.colmap)
    moved.transform(similarity)
    after = camera_sigmas(moved)
    assert [*after] == [*before]
    # Sigmas have four digits, so the last one may differ by rounding.
    np.testing.assert_allclose([*after.values()], [*before.values()], rtol=1e-3)


@pytest.mark.parametrize(
    "fault", ["a point behind a camera", "a point at infinity", "a point seen along one ray"]
)
def test_a_degenerate_model_has_no_sigmas_or_finite_ones(fault):
    model = pycolmap.Reconstruction(model_of(synthetic_scene(6, points=400)).colmap)
    number = min(model.point3D_ids())
    point = model.points3D[number]
    image = model.images[point.track.elements[0].image_id]
    centre = image.projection_center()
    places = {
        "a point behind a camera": centre - (point.xyz - centre),
        "a point at infinity": np.full(3, np.inf),
        "a point seen along one ray": centre + 1e12 * (point.xyz - centre),
    }
    point.xyz = places[fault]
    sigmas = camera_sigmas(model)
    assert all(np.isfinite(each).all() for each in sigmas.values())


def test_cameras_at_one_place_have_no_sigmas():
    """As of a panorama; the errors are shares of the model's size, which is 0."""
    model = pycolmap.Reconstruction(model_of(synthetic_scene(6, points=400)).colmap)
    for _, frame in sorted(model.frames.items()):
        rotation = frame.rig_from_world.rotation
        frame.rig_from_world = pycolmap.Rigid3d(rotation, np.zeros(3))
    assert camera_sigmas(model) == {}


def test_an_image_with_few_points_leaves_the_sigmas_of_the_others(tmp_path):
    """Its pose may be anywhere, and points that only it and one other image see are undetermined."""
    model = pycolmap.Reconstruction(model_of(synthetic_scene(7, points=400)).colmap)
    before = camera_sigmas(model)
    weak = seeing_images(model)[-1]
    observations = pycolmap.ObservationManager(model)
    seen = [number for number, each in enumerate(weak.points2D) if each.has_point3D()]
    for number in seen[3:]:
        observations.delete_observation(weak.image_id, number)
    after = camera_sigmas(model)
    assert weak.name not in after
    assert after.keys() == before.keys() - {weak.name}
    for name, sigmas in after.items():
        assert sigmas.centre < 3 * before[name].centre
