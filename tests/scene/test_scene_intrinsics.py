"""Intrinsics that the user knows: tables of them, and scenes with them."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.geometry.intrinsics import (
    LENS_MODELS,
    KnownCamera,
)
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.models import SfmModel, models_of
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import ViewGraph

SCENE = synthetic_scene(6, points=500)
NAMES = [image.name for image in SCENE.images]


def reconstructed(
    rows: list[tuple[str, KnownCamera]], sharing: CameraSharing = CameraSharing.AUTO
) -> SfmModel:
    graph = ViewGraph.of_pairs(SCENE.pairs).with_intrinsics(rows)
    found, _ = reconstruct_graph(graph, SceneConfig(cameras=sharing))
    (model,) = models_of(found)
    return model


def true_camera(name: str, factor: float = 1.0) -> tuple[str, KnownCamera]:
    """Return a row with the image's true camera, its focal length multiplied by `factor`."""
    K = SCENE.cameras[name].K
    focal = factor * K[0, 0]
    # COLMAP's (0, 0) is the corner of the first pixel.
    cx = K[0, 2] + 0.5
    cy = K[1, 2] + 0.5
    return name, KnownCamera("SIMPLE_PINHOLE", (focal, cx, cy))


def focal_ratios(model: SfmModel) -> dict[str, float]:
    """Return each image's focal length divided by the true one."""
    ratios = {}
    for found in model.images:
        name = found.image.name
        true_focal = SCENE.cameras[name].K[0, 0]
        ratios[name] = found.focal / true_focal
    return ratios


def test_photographs_of_one_content_are_one_image():
    pair = SCENE.pairs[0]
    copied = replace(pair.image0, name="a copy.jpg")
    pairs = [
        replace(pair, image0=copied),
        replace(pair, image0=pair.image1, image1=pair.image0),
    ]
    graph = ViewGraph.of_pairs(pairs)
    assert graph.names == ("a copy.jpg", pair.image1.name)
    assert len(graph.edges) == 1


@pytest.mark.parametrize("sharing", [CameraSharing.AUTO, CameraSharing.FOLDER])
def test_known_intrinsics_stay(sharing):
    names = NAMES[:3]
    # Wrong by 2 %, so that it shows whether the mapper has refined them.
    rows = [true_camera(name, 1.02) for name in names]
    model = reconstructed(rows, sharing)
    ratios = focal_ratios(model)
    for found in model.images:
        is_known = found.image.name in names
        has_stayed = ratios[found.image.name] == pytest.approx(1.02, abs=1e-9)
        assert has_stayed == is_known, found.image.name


def test_distortion_is_part_of_verification_and_of_the_model(tmp_path):
    known = []
    for name in NAMES:
        K = SCENE.cameras[name].K
        # The synthetic points have no distortion, so k1 is small: matches still agree with it.
        distortion = (1e-4, 0, 0, 0)
        pinhole = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
        known.append((name, KnownCamera("OPENCV", (*pinhole, *distortion))))
    graph = ViewGraph.of_pairs(SCENE.pairs).with_intrinsics(known)
    reconstruct_graph(graph, SceneConfig(), tmp_path)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        cameras = database.read_all_cameras()
        geometry = database.read_two_view_geometry(1, 2)
    assert {camera.model.name for camera in cameras} == {"OPENCV"}
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
    model = pycolmap.Reconstruction(tmp_path / "models" / "0")
    cameras_by_name = dict(known)
    for image in model.images.values():
        expected = cameras_by_name[image.name].parameters
        np.testing.assert_array_equal(image.camera.params, expected)


@pytest.mark.parametrize(
    ("model", "parameters", "reason"),
    [
        ("pinhole", (1, 1, 1, 1), "unknown camera model"),
        ("PINHOLE", (1, 1, 1), r"has 4 parameters \(fx, fy, cx, cy\)"),
        ("PINHOLE", (1, np.nan, 1, 1), "not finite"),
        ("PINHOLE", (1, -1, 1, 1), "must be positive"),
    ],
)
def test_parameters_that_no_camera_has_are_refused_with_the_reason(model, parameters, reason):
    with pytest.raises(ValueError, match=reason):
        KnownCamera(model, parameters)


def test_the_models_have_the_parameters_of_colmap():
    for name, parameters in LENS_MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
        assert len(camera.params) == len(parameters)
        colmap_parameters = camera.params_info.replace(" ", "").split(",")
        assert colmap_parameters == list(parameters)
