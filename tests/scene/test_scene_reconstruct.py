"""Reconstruction of small synthetic scenes: right cameras, the same bytes, and a reason whenever
there is none.
"""

import pickle
import sqlite3
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pytest

from benchmarks.synthetic_scene import (
    SIZE,
    SyntheticScene,
    arc_camera,
    front,
    match,
    registered_images,
    see,
    synthetic_scene,
)
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.reconstruct import Solution, reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(6, points=500)


def pair_of(names: str, matches: Matches) -> BatchPair:
    return BatchPair(*(BatchImage(name, f"digest {name}", SIZE) for name in names), matches)


def distances(solution: Solution, scene: SyntheticScene) -> list[float]:
    """How far true correspondences are from the F that each pair got, in pixels; infinite without
    an F.
    """
    return [
        np.inf if choice.F is None else scene.median_distance(choice.F, pair)
        for choice, pair in zip(solution.choices, scene.pairs, strict=True)
    ]


def test_cameras_are_right_in_spite_of_noise_and_wrong_matches(scene):
    solution = reconstruct_batch(scene.pairs, SceneConfig())
    (found,) = solution.reconstructions
    assert (found.registered, found.failure) == (6, "")
    assert max(distances(solution, scene)) < 0.5
    for image in scene.images:
        registered = registered_images(solution)[image.digest]
        assert registered.focal == pytest.approx(scene.cameras[image.name].K[0, 0], rel=0.03)
        assert registered.camera.K[:2, 2].tolist() == [SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5]
        assert registered.points > 50
    (model,) = found.models
    assert 0.1 < model.reprojection_error < 1
    assert len(model.points) > 200


def test_the_same_batch_gives_the_same_bytes_through_a_pipe_too(scene):
    # As a worker's process receives them
    piped = pickle.loads(pickle.dumps(scene.pairs))
    first, again = (
        pickle.dumps(reconstruct_batch(pairs, SceneConfig())) for pairs in (scene.pairs, piped)
    )
    assert first == again


def test_points_of_a_dense_matcher_make_tracks(scene):
    """Each pair has other points of the surface: a keypoint of two pairs is a coincidence within a
    cell.
    """
    rng = np.random.default_rng(3)
    pairs = []
    for pair in scene.pairs:
        world = front(rng, 8000)
        seen = [see(rng, camera, world, 0.3) for camera in scene.true_cameras(pair)]
        pairs.append(replace(pair, matches=match(rng, *seen, 0.1, None)))
    solution = reconstruct_batch(pairs, SceneConfig())
    (found,) = solution.reconstructions
    assert (found.registered, found.failure) == (6, "")
    assert max(distances(solution, scene)) < 1


@pytest.mark.parametrize("count", [3, 0])
def test_a_pair_with_few_matches_or_none_gets_the_scenes_fundamental(scene, count):
    # Its images have cameras by their other pairs.
    few = replace(scene.pairs[0], matches=scene.pairs[0].matches[:count])
    choice = reconstruct_batch((few, *scene.pairs[1:]), SceneConfig()).choices[0]
    assert choice.from_scene
    assert scene.median_distance(choice.F, few) < 0.5


def test_a_pair_that_the_scene_lacks_is_estimated_at_its_focal_lengths(scene):
    last = scene.images[-1]
    inside = [pair for pair in scene.pairs if last not in (pair.image0, pair.image1)]
    outside = next(pair for pair in scene.pairs if last in (pair.image0, pair.image1))
    # Enough for an F at a known focal length
    few = replace(outside, matches=outside.matches[:14])  # too few to place the image
    pairs = (few, replace(few, matches=few.matches[:3]), *inside)
    magsac = RobustConfig(permutations=1, max_iterations=2000)
    solution = reconstruct_batch(pairs, SceneConfig(), FocalConfig(), magsac)
    found, hopeless, *others = solution.choices
    assert (found.reason, found.from_scene) == (Reason.UNREGISTERED, False)
    assert scene.median_distance(found.F, few) < 5
    assert (hopeless.reason, hopeless.F) == (Reason.UNREGISTERED, None)
    assert all(choice.from_scene for choice in others)
    assert reconstruct_batch(pairs, SceneConfig()).choices[0].F is None


def test_two_places_in_a_batch_are_two_scenes(scene):
    # A row may name images of both places.
    other = synthetic_scene(4, points=500, seed=7, prefix="b")
    across = BatchPair(scene.images[0], other.images[0], Matches.empty())
    solution = reconstruct_batch((*scene.pairs, *other.pairs, across), SceneConfig())
    assert [found.registered for found in solution.reconstructions] == [6, 4]
    assert solution.choices[-1].reason is Reason.APART
    assert all(choice.from_scene for choice in solution.choices[:-1])


def test_a_pair_whose_matches_agree_on_something_else_keeps_its_own(scene):
    """As on a facade that repeats itself; whether it is right nobody knows, so the pair's own F
    stays.
    """
    pair = scene.pairs[-1]
    shifted = replace(pair.matches, points1=pair.matches.points0 + np.array([0, 90], np.float32))
    # F of a shift along y: its lines are the columns.
    columns = np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]) / np.sqrt(2)
    pairs = (*scene.pairs[:-1], replace(pair, matches=shifted, pair_fundamental=columns))
    solution = reconstruct_batch(pairs, SceneConfig(), FocalConfig())
    assert (solution.choices[-1].reason, solution.choices[-1].F) == (Reason.CONTRADICTION, None)
    assert all(choice.from_scene for choice in solution.choices[:-1])


def test_too_few_pairs_or_matches_make_no_scene(scene):
    # Three images on a chain
    two = tuple(pair for pair in scene.pairs if pair.image0 == scene.pairs[0].image0)[:2]
    (found,) = reconstruct_batch(two, SceneConfig()).reconstructions
    assert found.failure == (
        "2 matched pairs connect 3 images, and reliable cameras need 5; more overlapping images would help"
    )
    for none in ([], [pair_of("01", Matches.empty())]):
        assert reconstruct_batch(none, SceneConfig()).reconstructions == ()


POINTS, OTHERS = np.random.default_rng(0).uniform(10, 500, (2, 60, 2))
LINE = np.column_stack([POINTS[:, 0], POINTS[:, 0]])
DEGENERATE = {
    "random": (POINTS, OTHERS),
    "one point": (np.full((60, 2), 50.0), np.full((60, 2), 60.0)),
    "a line": (LINE, LINE + 5),
    "the same places": (POINTS, POINTS),
    # Of a plane, or a camera that only turned
    "a homography": (POINTS, POINTS[:, ::-1] * 0.9 + 20),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_matches_give_a_reason(kind):
    matches = Matches(*DEGENERATE[kind], np.ones(60))
    solution = reconstruct_batch(
        [pair_of(names, matches) for names in ("01", "12", "02", "23")], SceneConfig()
    )
    (found,) = solution.reconstructions
    assert found.models or found.failure
    for choice in solution.choices:
        assert choice.from_scene or choice.reason is not Reason.SCENE
        assert choice.F is None or np.isfinite(choice.F).all()


@pytest.mark.parametrize("is_missing", [True, False])
def test_a_missing_or_broken_pycolmap_is_a_reason(scene, monkeypatch, is_missing):
    def broken(*_: object) -> None:
        raise RuntimeError("disk I/O error")

    if is_missing:
        monkeypatch.delitem(sys.modules, "mkpc_kaggle.scene.colmap", raising=False)
        monkeypatch.setitem(sys.modules, "pycolmap", None)
    else:
        monkeypatch.setattr(colmap, "structure_from_motion", broken)
    solution = reconstruct_batch(scene.pairs, SceneConfig())
    told = "pycolmap cannot be imported" if is_missing else "pycolmap failed: disk I/O error"
    assert told in solution.reconstructions[0].failure
    assert {choice.reason for choice in solution.choices} == {Reason.UNREGISTERED}


def test_an_edge_is_verified_once_for_the_same_cameras_on_any_number_of_threads(
    scene, monkeypatch, tmp_path
):
    calls = []
    estimate = colmap.pycolmap.estimate_two_view_geometry

    def counted(*arguments: object) -> object:
        calls.append(arguments)
        return estimate(*arguments)

    # The scene, and its files, ask for all geometries.
    monkeypatch.setattr(colmap.pycolmap, "estimate_two_view_geometry", counted)
    written = []
    for threads in (1, 4):
        monkeypatch.setattr(colmap, "ThreadPoolExecutor", partial(ThreadPoolExecutor, threads))
        calls.clear()
        out = tmp_path / str(threads)
        reconstruct_batch(scene.pairs, SceneConfig(cameras=CameraSharing.IMAGE), export=out)
        assert len(calls) == len(scene.pairs)
        with closing(sqlite3.connect(out / "database.db")) as database:
            written.append([*database.iterdump()])
    assert written[0] == written[1]


def pairwise_scene() -> SyntheticScene:
    """Four images. The first hundred points are matched in all pairs, each other point in one pair."""
    rng = np.random.default_rng(0)
    world = front(rng, 9000)
    cameras = [arc_camera(rng, number / 3) for number in range(4)]
    ends = list(combinations(range(4), 2))
    indices = np.arange(len(world))
    seen = [see(rng, camera, world, 1.0) for camera in cameras]
    images = tuple(BatchImage(f"{number:04}", f"digest {number}", SIZE) for number in range(4))
    pairs = []
    for number, (first, second) in enumerate(ends):
        is_matched = (indices < 100) | (indices % len(ends) == number)
        seen0, seen1 = (
            (points[is_matched[points]], positions[is_matched[points]])
            for points, positions in (seen[first], seen[second])
        )
        matches = match(rng, seen0, seen1, 0.1, None)
        pairs.append(BatchPair(images[first], images[second], matches))
    names = [image.name for image in images]
    return SyntheticScene(images, tuple(pairs), dict(zip(names, cameras, strict=True)), world)


def test_cameras_also_fit_the_points_that_only_two_images_see(monkeypatch):
    scene = pairwise_scene()
    errors = []
    # The mapper's cameras alone, and after the last bundle adjustment
    for adjust in (lambda *_: None, colmap.adjust):
        monkeypatch.setattr(colmap, "adjust", adjust)
        (found,) = reconstruct_batch(scene.pairs, SceneConfig()).reconstructions
        (model,) = found.models
        errors.append(model.reprojection_error)
    before, after = errors
    assert after < 0.95 * before
