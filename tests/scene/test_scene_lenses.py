"""Lenses with distortion: found where photographs show them, and pinholes where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, synthetic_scene
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene.models import SfmModel, models_of
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

FOCAL = 840.0
CENTRE = np.array([SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5])
SCENE = synthetic_scene(6, points=500, focals=[FOCAL] * 6)
RADIAL = SceneConfig(camera_model=CameraModel.SIMPLE_RADIAL)


def distorted(points: np.ndarray, k: float) -> np.ndarray:
    """Return pixels as a lens with the radial coefficient ``k`` shows them."""
    rays = (points - CENTRE) / FOCAL
    bent = rays * (1 + k * (rays**2).sum(axis=1, keepdims=True))
    return np.asarray(bent * FOCAL + CENTRE)


def pairs_of(k: float) -> list[BatchPair]:
    """Return the pairs of the scene, through a lens."""
    pairs = []
    for pair in SCENE.pairs:
        points0 = distorted(pair.matches.points0, k)
        points1 = distorted(pair.matches.points1, k)
        pairs.append(replace(pair, by_unit=(Matches(points0, points1, pair.matches.scores),)))
    return pairs


def model_of(k: float, config: SceneConfig, *rows: tuple[str, KnownCamera]) -> SfmModel:
    graph = ViewGraph.of_pairs(pairs_of(k)).with_intrinsics(rows)
    (model,) = models_of(reconstruct_graph(graph, config)[0])
    assert len(model.images) == 6
    return model


def lenses_of(model: SfmModel) -> set[str]:
    return {image.lens.model for image in model.images if image.lens}


@pytest.mark.parametrize(
    ("k", "sharing"), [(-0.2, CameraSharing.AUTO), (0.1, CameraSharing.FOLDER)]
)
def test_a_lens_is_found_and_shared(k, sharing):
    model = model_of(k, replace(RADIAL, cameras=sharing))
    assert lenses_of(model) == {"SIMPLE_RADIAL"}
    (lens,) = {image.lens for image in model.images}
    assert lens is not None
    assert lens.parameters[-1] == pytest.approx(k, rel=0.05)
    assert lens.focal == pytest.approx(FOCAL, rel=0.02)
    assert all(image.has_distortion for image in model.images)


def test_a_lens_that_moves_no_pixel_by_more_than_one_is_a_pinhole():
    model = model_of(0.0, RADIAL)
    assert lenses_of(model) == {"SIMPLE_PINHOLE"}
    assert not any(image.has_distortion for image in model.images)
    assert [image.focal for image in model.images] == pytest.approx([FOCAL] * 6, rel=0.02)


@pytest.mark.parametrize(
    ("sharing", "all_tracks", "lens"),
    [
        (CameraSharing.FOLDER, 6, "SIMPLE_RADIAL"),
        (CameraSharing.IMAGE, 6, "SIMPLE_PINHOLE"),
        # A large scene is not adjusted to its pinholes.
        (CameraSharing.IMAGE, 5, "SIMPLE_RADIAL"),
    ],
)
def test_a_small_lens_needs_several_images(sharing, all_tracks, lens):
    """It moves no pixel by more than 0.7 % of the long side."""
    config = replace(RADIAL, cameras=sharing, all_tracks=all_tracks)
    assert lenses_of(model_of(-0.03, config)) == {lens}


def test_a_lens_that_the_user_gives_stays_however_flat_it_is():
    lens = KnownCamera("SIMPLE_RADIAL", (FOCAL, SIZE.width / 2, SIZE.height / 2, 1e-6))
    model = model_of(0.0, RADIAL, *[(image.name, lens) for image in SCENE.images])
    assert {image.lens for image in model.images} == {lens}


def test_a_fisheye_that_is_asked_for_is_found():
    """An equidistant lens shows a ray at its angle with the axis."""
    pairs = []
    for pair in SCENE.pairs:
        seen = []
        for points in (pair.matches.points0, pair.matches.points1):
            rays = (points - CENTRE) / FOCAL
            radius = np.linalg.norm(rays, axis=1, keepdims=True)
            seen.append(rays * np.arctan(radius) / radius * FOCAL + CENTRE)
        pairs.append(replace(pair, by_unit=(Matches(*seen, pair.matches.scores),)))
    config = SceneConfig(camera_model=CameraModel.SIMPLE_RADIAL_FISHEYE)
    (model,) = models_of(reconstruct_graph(ViewGraph.of_pairs(pairs), config)[0])
    assert lenses_of(model) == {"SIMPLE_RADIAL_FISHEYE"}
    assert len(model.images) == 6
    assert all(image.has_distortion for image in model.images)
    assert model.reprojection_error < 1
