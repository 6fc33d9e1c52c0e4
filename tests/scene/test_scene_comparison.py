"""Assumptions about cameras, compared with the photographs: what they contradict is found, and
nothing else.
"""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import SIZE, synthetic_scene
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import LENS_MODELS, KnownCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene import comparison
from mkpc_kaggle.scene.align import find_similarity, model_size, moved_by
from mkpc_kaggle.scene.comparison import compare_with_photographs
from mkpc_kaggle.scene.covariance import covariance_of
from mkpc_kaggle.scene.models import Comparison, FocalSource, SfmModel, models_of
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

FOCAL = 840.0
CENTRE = np.array([SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5])
SCENE = synthetic_scene(6, points=500, focals=[FOCAL] * 6)
# Of the table: pixels from the corner of the first one
MIDDLE = (SIZE.width / 2, SIZE.height / 2)


def distorted(points: np.ndarray, k: float) -> np.ndarray:
    """Return pixels as a lens with the radial coefficient ``k`` shows them."""
    rays = (points - CENTRE) / FOCAL
    bent = rays * (1 + k * (rays**2).sum(axis=1, keepdims=True))
    return np.asarray(bent * FOCAL + CENTRE)


def pairs_of(k: float = 0.0, exif: float = 0.0) -> list[BatchPair]:
    """Return the pairs of the scene, through a lens, and with a focal length in EXIF."""
    pairs = []
    for pair in SCENE.pairs:
        points0 = distorted(pair.matches.points0, k)
        points1 = distorted(pair.matches.points1, k)
        matches = Matches(points0, points1, pair.matches.scores)
        image0 = replace(pair.image0, focal=exif)
        image1 = replace(pair.image1, focal=exif)
        pairs.append(replace(pair, image0=image0, image1=image1, by_unit=(matches,)))
    return pairs


def model_of(
    pairs: list[BatchPair],
    *rows: tuple[str, KnownCamera],
    camera_model: CameraModel = CameraModel.SIMPLE_PINHOLE,
) -> SfmModel:
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(rows)
    found, _ = reconstruct_graph(graph, SceneConfig(camera_model=camera_model))
    (model,) = models_of(found)
    assert len(model.images) == 6
    return model


def pinhole(focal: float, sigma: float = 0.0) -> tuple[str, KnownCamera]:
    return "*", KnownCamera("SIMPLE_PINHOLE", (focal, *MIDDLE), sigma)


def test_right_assumptions_are_not_contradicted():
    assert model_of(pairs_of(exif=1.1 * FOCAL)).comparison == Comparison()
    assert model_of(pairs_of(), pinhole(FOCAL)).comparison == Comparison()
    # A wide prior leaves room for a wrong value.
    assert model_of(pairs_of(), pinhole(1.2 * FOCAL, 30.0)).comparison == Comparison()
    radial = KnownCamera("SIMPLE_RADIAL", (FOCAL, *MIDDLE, -0.1))
    assert model_of(pairs_of(-0.1), ("*", radial)).comparison == Comparison()


ZOOMED = synthetic_scene(
    6, points=500, focals=[FOCAL, FOCAL, FOCAL, FOCAL, 1.4 * FOCAL, 1.4 * FOCAL]
)


def test_a_row_that_does_not_fit_some_of_its_images_names_these():
    model = model_of(list(ZOOMED.pairs), pinhole(FOCAL))
    (focal,) = model.comparison.focals
    assert len(focal.images) == 2
    assert {*focal.images} < {image.image.name for image in model.images}
    assert focal.fitted == pytest.approx(1.4 * FOCAL, rel=0.1)


def test_images_that_a_shared_focal_length_does_not_fit_are_named():
    graph = ViewGraph.of_pairs(list(ZOOMED.pairs))
    (found,), _ = reconstruct_graph(graph, SceneConfig(cameras=CameraSharing.FOLDER))
    (model,) = found.models
    (focal,) = model.comparison.focals
    assert focal.source is FocalSource.SHARED
    assert {*focal.images} < {image.image.name for image in model.images}
    # Cameras that are shared only if they agree are right.
    (right,), _ = reconstruct_graph(graph, SceneConfig())
    assert [each.comparison for each in right.models] == [Comparison()]


@pytest.mark.parametrize(
    ("name", "ratio"),
    # Free distortion makes the ratio less certain.
    [("PINHOLE", 0.92), ("PINHOLE", 1.05), ("PINHOLE", 1.5), ("OPENCV", 0.92)],
)
def test_pixels_that_are_not_square_are_contradicted(name, ratio):
    axes = (FOCAL * ratio**0.5, FOCAL / ratio**0.5)
    distortion = (0.0,) * (len(LENS_MODELS[name]) - 4)
    model = model_of(pairs_of(), ("*", KnownCamera(name, (*axes, *MIDDLE, *distortion))))
    (focal,) = model.comparison.focals
    assert focal.given_axes == axes
    assert focal.fitted_axes == pytest.approx((FOCAL, FOCAL), rel=0.03)
    assert focal.fitted_axes[0] / focal.fitted_axes[1] == pytest.approx(1, abs=0.02)


def test_a_right_ratio_of_the_focal_lengths_is_not_contradicted():
    stretched = []
    for pair in pairs_of():
        points = [each * (1.0, 1.2) for each in (pair.matches.points0, pair.matches.points1)]
        matches = Matches(*map(np.float32, points), pair.matches.scores)
        size = Size(SIZE.width, round(1.2 * SIZE.height))
        image0 = replace(pair.image0, size=size)
        image1 = replace(pair.image1, size=size)
        stretched.append(replace(pair, image0=image0, image1=image1, by_unit=(matches,)))
    middle = (SIZE.width / 2, 0.6 * SIZE.height)
    camera = KnownCamera("PINHOLE", (FOCAL, 1.2 * FOCAL, *middle))
    assert model_of(stretched, ("*", camera)).comparison == Comparison()


@pytest.mark.parametrize("k", [-0.2, -0.05, 0.1])
def test_a_lens_with_distortion_is_found_with_its_coefficient(k):
    model = model_of(pairs_of(k))
    (lens,) = model.comparison.lenses
    assert model.comparison.focals == ()
    assert len(lens.images) == 6
    *pinhole_parameters, coefficient = lens.camera.parameters
    assert coefficient == pytest.approx(k, rel=0.2)
    assert pinhole_parameters[0] == pytest.approx(FOCAL, rel=0.03)
    # At the end of the long side: r = 400 / 840.
    assert lens.displacement == pytest.approx(k * (400 / FOCAL) ** 2, rel=0.2)
    # The row to give ends the contradiction, and the cameras are better.
    given = model_of(pairs_of(k), ("*", lens.camera))
    assert given.comparison == Comparison()


def centre_errors(model: SfmModel) -> np.ndarray:
    """Return the error of each centre after a similarity, as a share of the model's size."""
    true = [SCENE.cameras[image.image.name] for image in model.images]
    similarity = find_similarity([image.camera for image in model.images], true)
    assert similarity is not None
    moved = [similarity.of_camera(image.camera) for image in model.images]
    return np.asarray(moved_by(moved, true)) / model_size(true)


@pytest.mark.parametrize("k", [-0.2, 0.1])
def test_a_lens_that_the_photographs_show_is_adopted(k):
    model = model_of(pairs_of(k), camera_model=CameraModel.AUTO)
    (lens,) = model.comparison.lenses
    assert lens.is_adopted
    assert len(lens.images) == 6
    for image in model.images:
        assert image.lens is not None
        assert image.lens.model == "SIMPLE_RADIAL"
        assert image.lens.distortion == pytest.approx((k,), rel=0.05)
        assert image.has_distortion
    bent = centre_errors(model_of(pairs_of(k)))
    right = centre_errors(model)
    assert right.max() < bent.max() / 5
    # Expected errors include the lens.
    sigmas = np.array([image.sigmas.centre for image in model.images if image.sigmas])
    assert len(sigmas) == 6
    assert (right < 3 * sigmas).all()


def test_no_lens_is_adopted_that_the_photographs_do_not_show():
    model = model_of(pairs_of(), camera_model=CameraModel.AUTO)
    assert model.comparison == Comparison()
    assert {image.lens.model for image in model.images if image.lens} == {"SIMPLE_PINHOLE"}


def test_noise_is_no_lens():
    """The points of these five pinholes fit distortions that are large, and uncertain by more than that."""
    scene = synthetic_scene(5, points=300, noise=2.5, focals=[1000.0] * 5)
    found, _ = reconstruct_graph(ViewGraph.of_pairs(scene.pairs), SceneConfig())
    (model,) = models_of(found)
    assert len(model.images) == 5
    assert model.comparison.lenses == ()


def test_a_pinhole_that_the_user_gives_is_contradicted_and_stays():
    known = pinhole(FOCAL, 20.0)
    model = model_of(pairs_of(-0.2), known, camera_model=CameraModel.AUTO)
    (lens,) = model.comparison.lenses
    assert not lens.is_adopted
    assert {image.lens.model for image in model.images if image.lens} == {"SIMPLE_PINHOLE"}


def test_cameras_that_the_user_shares_share_the_adopted_lens():
    config = SceneConfig(cameras=CameraSharing.FOLDER)
    (found,), shared = reconstruct_graph(ViewGraph.of_pairs(pairs_of(-0.2)), config)
    (model,) = found.models
    assert len({image.lens for image in model.images}) == 1
    assert set(shared.values()) == {model.images[0].focal}
    assert model.comparison.lenses[0].camera.distortion == pytest.approx((-0.2,), rel=0.05)


@pytest.mark.parametrize(("factor", "sigma"), [(0.7, 0.0), (1.4, 0.0), (1.4, 5.0)])
def test_a_wrong_focal_length_of_the_user_is_found_with_the_right_one(factor, sigma):
    model = model_of(pairs_of(), pinhole(factor * FOCAL, sigma))
    (focal,) = model.comparison.focals
    assert model.comparison.lenses == ()
    assert (focal.source, len(focal.images)) == (FocalSource.INTRINSICS, 6)
    assert focal.given == pytest.approx(factor * FOCAL)
    assert focal.fitted == pytest.approx(FOCAL, rel=0.1)


@pytest.mark.parametrize(("given", "true"), [(0.2, -0.1), (-0.25, 0.0)])
def test_a_wrong_distortion_of_the_user_is_found_with_the_right_one(given, true):
    known = KnownCamera("SIMPLE_RADIAL", (FOCAL, *MIDDLE, given))
    model = model_of(pairs_of(true), ("*", known), camera_model=CameraModel.AUTO)
    (found,) = model.comparison.distortions
    assert model.comparison.lenses == ()
    assert len(found.images) == 6
    at_the_edge = (400 / FOCAL) ** 2
    assert found.given == pytest.approx(given * at_the_edge)
    assert found.fitted == pytest.approx(true * at_the_edge, abs=0.01)
    assert found.camera.model == "SIMPLE_RADIAL"


def test_noise_contradicts_no_distortion_of_the_user():
    scene = synthetic_scene(5, points=300, noise=2.5, seed=6, focals=[1000.0] * 5)
    known = KnownCamera("SIMPLE_RADIAL", (1000.0, *MIDDLE, 1e-6))
    graph = ViewGraph.of_pairs(scene.pairs).with_intrinsics([("*", known)])
    found, _ = reconstruct_graph(graph, SceneConfig())
    (model,) = models_of(found)
    assert len(model.images) == 5
    assert model.comparison == Comparison()


def test_a_wrong_focal_length_of_exif_is_found_unless_the_user_knows_the_camera():
    model = model_of(pairs_of(exif=1.5 * FOCAL))
    (focal,) = model.comparison.focals
    assert (focal.source, len(focal.images)) == (FocalSource.EXIF, 6)
    assert focal.given == pytest.approx(1.5 * FOCAL)
    assert focal.fitted == pytest.approx(FOCAL, rel=0.02)
    assert model_of(pairs_of(exif=1.5 * FOCAL), pinhole(FOCAL)).comparison == Comparison()


def test_the_covariance_is_computed_once_for_all_rows(monkeypatch):
    rows = [
        (image.name, KnownCamera("SIMPLE_PINHOLE", (1.2 * FOCAL + number, *MIDDLE)))
        for number, image in enumerate(SCENE.images)
    ]
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return covariance_of(*arguments)

    monkeypatch.setattr(comparison, "covariance_of", counted)
    model = model_of(pairs_of(), *rows)
    assert len(model.comparison.focals) == len(rows)
    assert len(calls) == 1


def test_the_comparison_leaves_the_model_as_it_is():
    model = model_of(pairs_of(-0.1))
    before = pycolmap.Reconstruction(model.colmap)
    compare_with_photographs(model, {})
    for number, camera in before.cameras.items():
        assert model.colmap.cameras[number].model == camera.model
        np.testing.assert_array_equal(model.colmap.cameras[number].params, camera.params)
    for number, image in before.images.items():
        after = model.colmap.images[number].cam_from_world().matrix()
        np.testing.assert_array_equal(after, image.cam_from_world().matrix())
