"""The errors to expect of cameras: true on scenes with known cameras, in any world, larger for few
points.
"""

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from benchmarks.synthetic_scene import SyntheticScene, synthetic_scene
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.reconstruct import reconstruct_batch
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.uncertainty import camera_sigmas


def model_of(scene: SyntheticScene) -> SfmModel:
    solution = reconstruct_batch(scene.pairs, SceneConfig(cameras=CameraSharing.IMAGE))
    ((model,),) = (found.models for found in solution.reconstructions)
    return model


def errors_over_sigmas(model: SfmModel, scene: SyntheticScene) -> np.ndarray:
    """Of each image: the errors of rotation, centre and focal length in the frame of all cameras,
    (N, 3).
    """
    true = [scene.cameras[found.image.name] for found in model.images]
    cameras = [found.camera for found in model.images]
    world = (
        Rotation.from_matrix([a.R.T @ b.R for a, b in zip(cameras, true, strict=True)])
        .mean()
        .as_matrix()
    )
    centres, places = (np.array([-c.R.T @ c.t for c in each]) for each in (cameras, true))
    # A similarity of the world is no error.
    centres = centres - centres.mean(axis=0)
    places = (places - places.mean(axis=0)) @ world.T
    size = np.sqrt((centres**2).sum(axis=1).mean())
    places *= (centres * places).sum() / (places**2).sum()
    turns = Rotation.from_matrix(
        [a.R @ world @ b.R.T for a, b in zip(cameras, true, strict=True)]
    ).magnitude()
    errors = [
        np.degrees(turns),
        np.linalg.norm(centres - places, axis=1) / size,
        [abs(100 * (a.K[0, 0] / b.K[0, 0] - 1)) for a, b in zip(cameras, true, strict=True)],
    ]
    return np.column_stack(errors) / [found.sigmas for found in model.images]


def test_errors_are_about_as_large_as_expected():
    """90 % of normal errors are below 1.645 sigma; of three dimensions, below 1.44 to 1.645."""
    # 32 cameras; the bounds leave room for their number.
    scenes = [synthetic_scene(8, points=400, seed=seed) for seed in range(4)]
    ratios = np.concatenate([errors_over_sigmas(model_of(scene), scene) for scene in scenes])
    assert ((ratios < 1.645).mean(axis=0) > 0.7).all()
    assert (np.abs(np.log(np.sqrt((ratios**2).mean(axis=0)))) < np.log(1.5)).all()


def test_they_are_the_same_in_another_world():
    model = model_of(synthetic_scene(6, points=400))
    before = camera_sigmas(model.colmap)
    moved = pycolmap.Reconstruction(model.colmap)
    # Another scale, orientation and origin
    moved.transform(
        pycolmap.Sim3d(3.0, pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1])), np.array([5.0, -2, 1]))
    )
    after = camera_sigmas(moved)
    assert [*after] == [*before]
    np.testing.assert_allclose([*after.values()], [*before.values()], rtol=1e-3)
