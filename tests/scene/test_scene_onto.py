"""New images among the cameras of a finished model, of a graph of true cameras."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.synthetic_scene import SyntheticScene, synthetic_scene
from mkpc_kaggle.geometry.intrinsics import KnownCamera, PlacedCamera, Rows
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene.export import MODELS, HeldDirectory
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.mapper import reconstruct_connected
from mkpc_kaggle.scene.models import Comparison, Reconstruction, SfmModel
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

FOCAL = 840.0
MIDDLE = (400.0, 300.0)  # from the corner of the first pixel
SCENE = synthetic_scene(8, points=500, focals=[FOCAL] * 8)
CONFIG = SceneConfig()
OLD = 5  # images of the finished model
EMPTY = Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def name_of(number: int) -> str:
    return f"{number:04}"


def placed(scene: SyntheticScene, numbers: Sequence[int]) -> Rows:
    """Return the rows of a finished model with the true cameras."""
    rows = []
    for name in map(name_of, numbers):
        camera = scene.cameras[name]
        pose = (*Rotation.from_matrix(camera.R).as_quat(), *camera.t)
        rows.append((name, PlacedCamera("SIMPLE_PINHOLE", (FOCAL, *MIDDLE), pose=pose)))
    return rows


def without_matches(pairs: Sequence[BatchPair], number: int) -> list[BatchPair]:
    """Return the pairs, as if one of the images were blank."""
    return [
        replace(pair, by_unit=(EMPTY,))
        if name_of(number) in (pair.image0.name, pair.image1.name)
        else pair
        for pair in pairs
    ]


def model_of(pairs: Sequence[BatchPair], rows: Rows, config: SceneConfig = CONFIG) -> SfmModel:
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(rows)
    (found,), _ = reconstruct_graph(graph, config, is_whole=True)
    assert found.failure == ""
    (model,) = found.models
    return model


def names_of(model: SfmModel) -> set[str]:
    return {image.image.name for image in model.images}


def assert_in_place(model: SfmModel, rows: Rows) -> None:
    """Every camera of the finished model is in the new one, but for the rounding of its quaternion."""
    for name, camera in rows:
        image = model.colmap.find_image_with_name(name)
        assert image.cam_from_world().params.tolist() == pytest.approx(camera.pose, abs=1e-14), name
        assert tuple(image.camera.params) == camera.parameters, name


def test_a_new_image_without_matches_leaves_the_others():
    rows = placed(SCENE, range(OLD))
    model = model_of(without_matches(SCENE.pairs, OLD + 1), rows)
    assert names_of(model) == {*SCENE.cameras} - {name_of(OLD + 1)}
    assert model.comparison == Comparison()
    assert_in_place(model, rows)


def test_an_image_of_the_model_without_matches_keeps_its_camera():
    rows = placed(SCENE, range(OLD))
    model = model_of(without_matches(SCENE.pairs, 2), rows)
    assert names_of(model) == {*SCENE.cameras}
    assert model.comparison == Comparison()
    assert_in_place(model, rows)


def test_the_cameras_of_a_model_stay_in_the_third_one(tmp_path: Path):
    """The second model has new cameras, which the mapper of the third must not round."""
    rows = placed(SCENE, range(3))
    for number, count in enumerate((7, 8)):
        pairs = [pair for pair in SCENE.pairs if int(pair.image1.name) < count]
        graph = ViewGraph.of_pairs(pairs).with_intrinsics(rows)
        held = HeldDirectory.of(tmp_path / str(number))
        (found,), _ = reconstruct_graph(graph, CONFIG, held)
        assert found.registered == count
        model = pycolmap.Reconstruction(held.path / MODELS / "0")
        before = dict(rows)
        rows = []
        for image in model.images.values():
            parameters = tuple(image.camera.params)
            pose = tuple(image.cam_from_world().params)
            rows.append((image.name, PlacedCamera("SIMPLE_PINHOLE", parameters, pose=pose)))
    new = before.keys() - {name for name, _ in placed(SCENE, range(3))}
    assert len(new) == 4
    assert {name: dict(rows)[name] for name in new} == {name: before[name] for name in new}


def test_new_cameras_are_as_exact_far_from_the_origin():
    """As onto a model in coordinates such as UTM's."""
    errors = []
    for origin in (np.zeros(3), np.array([5e5, 5e6, 100])):
        rows = []
        for name, camera in placed(SCENE, range(OLD)):
            R = SCENE.cameras[name].R
            pose = (*camera.pose[:4], *(camera.pose[4:] - R @ origin))
            rows.append((name, PlacedCamera(camera.model, camera.parameters, pose=pose)))
        model = model_of(SCENE.pairs, rows)
        assert len(model.images) == 8
        assert model.comparison == Comparison()
        assert_in_place(model, rows)
        centres = np.array([image.camera.centre for image in model.images]) - origin
        truth = np.array([SCENE.cameras[image.image.name].centre for image in model.images])
        errors.append(np.linalg.norm(centres - truth, axis=1))
        points = np.median(model.points - origin, axis=0)
        assert points == pytest.approx(np.median(SCENE.world, axis=0), abs=1.0)
    assert errors[1] == pytest.approx(errors[0], abs=1e-4)


def distorted(pair: BatchPair, k: float, numbers: Collection[int]) -> BatchPair:
    """Return a pair whose images, if they are among these numbers, show the lens with the coefficient k."""
    points = [pair.matches.points0, pair.matches.points1]
    for side, image in enumerate((pair.image0, pair.image1)):
        if int(image.name) in numbers:
            rays = (points[side] - np.subtract(MIDDLE, 0.5)) / FOCAL
            points[side] = points[side] + FOCAL * k * rays * (rays**2).sum(axis=1, keepdims=True)
    return replace(pair, by_unit=(Matches(*points, pair.matches.scores),))


def test_new_images_have_the_lens_of_the_model_only_if_they_show_it():
    lens = ("SIMPLE_RADIAL", (FOCAL, *MIDDLE, -0.05))
    rows = [
        (name, PlacedCamera(*lens, pose=camera.pose)) for name, camera in placed(SCENE, range(OLD))
    ]
    new = range(OLD, 8)
    for numbers, has_lens in ((range(8), True), (range(OLD), False)):
        model = model_of([distorted(pair, -0.05, numbers) for pair in SCENE.pairs], rows)
        assert names_of(model) == {*SCENE.cameras}
        lenses = [image.lens for image in model.images if int(image.image.name) in new]
        coefficients = [lens.distortion for lens in lenses if lens]
        assert (coefficients == [(-0.05,)] * 3) == has_lens
        truth = -0.05 if has_lens else 0.0
        assert [k for (k,) in coefficients] == pytest.approx([truth] * 3, abs=0.015)


def test_new_images_share_the_camera_of_a_model_with_another_camera_model():
    """Of the new images, one has its own camera, and the others are declared to share one."""
    rows = [
        (name, PlacedCamera("PINHOLE", (FOCAL, FOCAL, *MIDDLE), pose=camera.pose))
        for name, camera in placed(SCENE, range(OLD))
    ]
    # Without a camera in the first reconstruction
    pairs = without_matches(SCENE.pairs, OLD)
    config = SceneConfig(camera_model=CameraModel.SIMPLE_PINHOLE, cameras=CameraSharing.FOLDER)
    model = model_of(pairs, rows, config)
    assert names_of(model) == {*SCENE.cameras} - {name_of(OLD)}
    assert {image.lens for image in model.images} == {
        KnownCamera("PINHOLE", (FOCAL, FOCAL, *MIDDLE))
    }


def test_a_wrong_camera_of_the_model_is_no_row_of_the_user():
    lens = KnownCamera("SIMPLE_RADIAL", (FOCAL, *MIDDLE, -0.12))
    old = {*map(name_of, range(OLD))}
    pairs = [pair for pair in SCENE.pairs if {pair.image0.name, pair.image1.name} <= old]
    first = model_of(pairs, [("*", lens)])
    rows = []
    for image in first.images:
        pose = first.colmap.find_image_with_name(image.image.name).cam_from_world()
        camera = PlacedCamera(lens.model, lens.parameters, pose=tuple(pose.params))
        rows.append((image.image.name, camera))
    model = model_of(SCENE.pairs, rows)
    assert len(model.images) == 8
    assert model.comparison.focals == ()
    assert model.comparison.distortions == ()


def test_a_refinement_without_the_matches_of_an_image_leaves_the_image_out():
    pairs = [pair for pair in SCENE.pairs if int(pair.image1.name) < OLD]
    first = reconstruct_connected(MergedGraph(ViewGraph.of_pairs(pairs)), {}, CONFIG)
    assert first.registered == OLD
    lacking = MergedGraph(ViewGraph.of_pairs(without_matches(pairs, 3)))
    second = reconstruct_connected(lacking, {}, CONFIG, first.models)
    assert second.failure == ""
    assert names_of(second.models[0]) == {name_of(number) for number in (0, 1, 2, 4)}


@pytest.mark.parametrize("error", [KeyError("6"), IndexError("6"), ValueError("6")])
def test_an_error_within_a_reconstruction_is_a_reason(monkeypatch, error):
    from mkpc_kaggle.scene import colmap

    def failing(*arguments: object) -> Reconstruction:
        raise error

    monkeypatch.setattr(colmap, "structure_from_motion", failing)
    found = reconstruct_connected(MergedGraph(ViewGraph.of_pairs(SCENE.pairs)), {}, CONFIG)
    assert found.models == ()
    assert "6" in found.failure
