"""Intrinsics that the user knows: tables of them, and scenes with exact and with uncertain ones."""

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.geometry.intrinsics import MODELS, KnownCamera, camera_of, parse_row, read, written
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene.reconstruct import models_of, reconstruct_sharing
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.uncertainty import combined
from mkpc_kaggle.scene.view_graph import ViewGraph

SCENE = synthetic_scene(6, points=500)
NAMES = [image.name for image in SCENE.images]


def reconstructed(
    rows: list[tuple[str, KnownCamera]], sharing: CameraSharing = CameraSharing.AUTO
) -> SfmModel:
    config = SceneConfig(cameras=sharing, intrinsics=written(rows))
    found, _ = reconstruct_sharing(ViewGraph.of_pairs(SCENE.pairs), config)
    (model,) = models_of(found)
    return model


def true_camera(name: str, factor: float = 1.0, sigma: float = 0.0) -> tuple[str, KnownCamera]:
    K = SCENE.cameras[name].K
    # COLMAP's (0, 0) is the corner of the first pixel.
    return name, KnownCamera(
        "SIMPLE_PINHOLE", (factor * K[0, 0], K[0, 2] + 0.5, K[1, 2] + 0.5), sigma
    )


def focals(model: SfmModel) -> dict[str, float]:
    """The focal length of each image over the true one."""
    return {
        found.image.name: found.focal / SCENE.cameras[found.image.name].K[0, 0]
        for found in model.images
    }


@pytest.fixture(scope="module")
def free() -> SfmModel:
    return reconstructed([])


@pytest.mark.parametrize("sharing", [CameraSharing.AUTO, CameraSharing.FOLDER])
def test_exact_intrinsics_stay_and_have_no_uncertainty(free, sharing):
    # Wrong by 2 %, so that it shows whether the mapper has refined them
    names = NAMES[:3]
    model = reconstructed([true_camera(name, 1.02) for name in names], sharing)
    for found in model.images:
        is_known = found.image.name in names
        assert (focals(model)[found.image.name] == pytest.approx(1.02, abs=1e-9)) == is_known
        assert (found.sigmas.focal == 0) == is_known


def test_intrinsics_that_are_all_exact_leave_less_uncertainty(free):
    model = reconstructed([true_camera(name) for name in NAMES])
    assert focals(model) == pytest.approx(dict.fromkeys(NAMES, 1.0), abs=1e-9)
    for field in ("rotation", "centre"):
        known, unknown = (
            np.mean([getattr(each.sigmas, field) for each in made.images]) for made in (model, free)
        )
        assert known < unknown


def test_a_prior_pulls_a_focal_length_as_far_as_its_deviation_allows(free):
    name = NAMES[2]
    start = focals(free)[name]
    # A prior of 0.01 % decides alone, one of 100 % says nothing.
    pulled = {
        sigma: focals(reconstructed([true_camera(name, 1.1, sigma)]))[name]
        for sigma in (0.01, 100.0)
    }
    assert pulled[0.01] == pytest.approx(1.1, abs=2e-3)
    assert pulled[100.0] == pytest.approx(start, abs=2e-3)
    # Two measurements together are better than the prior alone.
    model = reconstructed([true_camera(name, 1.0, 0.1)])
    (sigma,) = (found.sigmas.focal for found in model.images if found.image.name == name)
    assert 0 < sigma < 0.1


def test_distortion_is_part_of_verification_and_of_the_model(tmp_path):
    known = [
        (
            name,
            KnownCamera("OPENCV", (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, 1e-4, 0, 0, 0)),
        )
        for name, K in ((name, SCENE.cameras[name].K) for name in NAMES)
    ]
    config = SceneConfig(intrinsics=written(known))
    reconstruct_sharing(ViewGraph.of_pairs(SCENE.pairs), config, tmp_path)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        cameras = database.read_all_cameras()
        geometry = database.read_two_view_geometry(1, 2)
    assert {camera.model.name for camera in cameras} == {"OPENCV"}
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
    model = pycolmap.Reconstruction(tmp_path / "models" / "0")
    for image in model.images.values():
        np.testing.assert_array_equal(image.camera.params, dict(known)[image.name].parameters)


def test_a_row_names_an_image_by_its_path_its_name_or_a_pattern():
    rows = [
        parse_row(pattern, "SIMPLE_PINHOLE", f"{focal} 10 10", "fixed")
        for focal, pattern in enumerate(
            ("set/a.jpg", "b.jpg", "[c].jpg", "set/*", "*.png"), start=1
        )
    ]
    # [c].jpg is a name and a pattern; the first row that fits counts.
    names = ["set/a.jpg", "x/b.jpg", "[c].jpg", "c.jpg", "set/z.jpg", "y/z.png", "z.jpg"]
    found = [camera_of(rows, name) for name in names]
    assert [camera and camera.focal for camera in found] == [1, 2, 3, 3, 4, 5, None]
    assert read(written(rows)) == rows


@pytest.mark.parametrize(
    ("cells", "reason"),
    [
        (("", "PINHOLE", "1 1 1 1", "fixed"), "the name of the image is missing"),
        (("a", "pinhole", "1 1 1 1", "fixed"), "unknown camera model"),
        (("a", "PINHOLE", "1 1 1", "fixed"), r"has 4 parameters \(fx, fy, cx, cy\)"),
        (("a", "PINHOLE", "1 nan 1 1", "fixed"), "not finite"),
        (("a", "PINHOLE", "1 x 1 1", "fixed"), "could not convert"),
        (("a", "PINHOLE", "1 -1 1 1", "fixed"), "must be positive"),
        (("a", "PINHOLE", "1 1 1 1", "0"), "above 0"),
        (("a", "PINHOLE", "1 1 1 1", "nan"), "must be 'fixed'"),
        (("a", "PINHOLE", "1 1 1 1", "101"), "at most 100 percent"),
        (("a", "PINHOLE", "1 1 1 1", "exact"), "could not convert"),
    ],
)
def test_a_row_that_no_camera_has_is_refused_with_the_reason(cells, reason):
    with pytest.raises(ValueError, match=reason):
        parse_row(*cells)


def test_the_models_have_the_parameters_of_colmap():
    for name, parameters in MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
        assert len(camera.params) == len(parameters)
        assert camera.params_info.replace(" ", "").split(",") == list(parameters)


def test_deviations_combine_as_those_of_independent_measurements():
    assert combined(3.0, 4.0) == pytest.approx(2.4)
