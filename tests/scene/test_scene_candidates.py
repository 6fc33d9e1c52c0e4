"""Candidates of a scene, and their judge: cameras against F of single pairs."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import SceneConfig, Unit
from mkpc_kaggle.scene.candidates import (
    ALL_UNITS,
    SUPPORTED,
    best_of,
    candidate_tracks,
    candidates_of,
    disagreement,
)
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import tracks_of

MANY, FEW = Unit(1, "many", 640), Unit(1, "few", 640)
SCENE = synthetic_scene(5, points=100)
PAIRS = [
    replace(pair, pair_fundamental=fundamental_of_cameras(*SCENE.true_cameras(pair)))
    for pair in SCENE.pairs
]
IMAGES = {image.digest: image for pair in PAIRS for image in (pair.image0, pair.image1)}


def true_camera(digest: str) -> Camera:
    for pair in PAIRS:
        ends = (pair.image0.digest, pair.image1.digest)
        if digest in ends:
            return SCENE.true_cameras(pair)[ends.index(digest)]
    raise AssertionError(digest)


def model(bent: float = 0.0, images: int = 5) -> SfmModel:
    """The true cameras of the first images; each second one is turned by so many degrees."""
    angle = np.radians(bent)
    turn = np.array(
        [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
    )
    registered = []
    for number, digest in enumerate(sorted(IMAGES)[:images]):
        camera = true_camera(digest)
        if number % 2:
            camera = replace(camera, R=turn @ camera.R)
        registered.append(RegisteredImage(IMAGES[digest], camera, 99))
    return SfmModel(tuple(registered), np.zeros((0, 3)), 0.5)


def test_cameras_disagree_more_the_more_they_are_bent():
    values = [disagreement(PAIRS, [model(bent)]) for bent in (0, 0.1, 0.5, 2, 8)]
    assert values == sorted(values)
    assert values[0] == pytest.approx(0, abs=1e-3)
    # Six of ten pairs have one of the two turned images.
    assert values[3] == pytest.approx(0.6 * 2, rel=0.05)


def test_one_wrong_pair_counts_as_ten_degrees_at_most():
    first, *others = PAIRS
    wrong = replace(first, pair_fundamental=PAIRS[-1].pair_fundamental)
    assert disagreement([wrong, *others], [model()]) <= 1.0 + 1e-3


def test_cameras_of_a_part_of_the_images_do_not_win_by_leaving_out_the_rest():
    # Three of ten pairs have cameras.
    assert disagreement(PAIRS, [model(images=3)]) == pytest.approx(7.0, abs=1e-3)
    assert disagreement(PAIRS, []) == 10.0


@pytest.mark.parametrize(
    ("units", "most", "expected"),
    [
        ((MANY, FEW), 1, (ALL_UNITS,)),
        ((MANY, FEW), 2, (ALL_UNITS, SUPPORTED)),
        ((MANY, FEW), 9, (ALL_UNITS, SUPPORTED, MANY.name, FEW.name)),
        ((MANY,), 9, (ALL_UNITS,)),
        ((MANY, replace(FEW, tracks=False)), 9, (ALL_UNITS,)),
    ],
)
def test_candidates_are_all_units_then_each_one_that_makes_tracks(units, most, expected):
    assert candidates_of(units, SceneConfig(candidates=most)) == expected
    assert candidates_of(units, None) == (ALL_UNITS,)


def test_a_candidate_of_one_unit_has_the_tracks_of_that_unit():
    matches = PAIRS[0].matches
    few = Matches(matches.points0[::2], matches.points1[::2], matches.scores[::2])
    results = (UnitResult(MANY, matches), UnitResult(FEW, few))
    assert len(candidate_tracks(results, FEW.name)) == len(few)
    for candidate in (ALL_UNITS, SUPPORTED):
        assert len(candidate_tracks(results, candidate)) == len(tracks_of(results))


def test_the_first_candidate_stays_unless_another_is_clearly_better():
    assert best_of({ALL_UNITS: 2.0, MANY.name: 2.0}) == ALL_UNITS
    assert best_of({ALL_UNITS: 2.0, MANY.name: 1.99}) == ALL_UNITS
    assert best_of({ALL_UNITS: 2.0, MANY.name: 1.5, FEW.name: 1.5}) == MANY.name
    assert best_of({ALL_UNITS: 0.0, MANY.name: 0.0}) == ALL_UNITS
