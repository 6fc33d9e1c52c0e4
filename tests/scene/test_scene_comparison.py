"""Assumptions about cameras, compared with the photographs: what they contradict is found, and
nothing else.
"""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import SIZE, synthetic_scene
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.comparison import compare_with_photographs
from mkpc_kaggle.scene.models import Comparison, FocalSource, SfmModel
from mkpc_kaggle.scene.sfm import models_of, reconstruct_sharing
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


def model_of(pairs: list[BatchPair], *rows: tuple[str, KnownCamera]) -> SfmModel:
    graph = ViewGraph.of_pairs(pairs).with_intrinsics(rows)
    found, _ = reconstruct_sharing(graph, SceneConfig())
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


@pytest.mark.parametrize(("factor", "sigma"), [(0.7, 0.0), (1.4, 0.0), (1.4, 5.0)])
def test_a_wrong_focal_length_of_the_user_is_found_with_the_right_one(factor, sigma):
    model = model_of(pairs_of(), pinhole(factor * FOCAL, sigma))
    (focal,) = model.comparison.focals
    assert model.comparison.lenses == ()
    assert (focal.source, len(focal.images)) == (FocalSource.INTRINSICS, 6)
    assert focal.given == pytest.approx(factor * FOCAL)
    assert focal.fitted == pytest.approx(FOCAL, rel=0.1)


def test_a_wrong_focal_length_of_exif_is_found_unless_the_user_knows_the_camera():
    model = model_of(pairs_of(exif=1.5 * FOCAL))
    (focal,) = model.comparison.focals
    assert (focal.source, len(focal.images)) == (FocalSource.EXIF, 6)
    assert focal.given == pytest.approx(1.5 * FOCAL)
    assert focal.fitted == pytest.approx(FOCAL, rel=0.02)
    assert model_of(pairs_of(exif=1.5 * FOCAL), pinhole(FOCAL)).comparison == Comparison()


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
