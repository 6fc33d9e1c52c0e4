"""Reconstruction of small synthetic scenes: right cameras, the same bytes, reasons of failures."""

import pickle
import sqlite3
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.synthetic_scene import (
    SIZE,
    SyntheticScene,
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
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.sfm import Solution, map_graph, reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, ViewGraph


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(6, points=500)


def pair_of(names: str, matches: Matches) -> BatchPair:
    """Return a pair of two images, each named by one character."""
    image0, image1 = (BatchImage(name, f"digest {name}", SIZE) for name in names)
    return BatchPair(image0, image1, (matches,))


def distances(solution: Solution, scene: SyntheticScene) -> list[float]:
    """Return each pair's median distance of true correspondences under its F, in pixels.

    Infinite without an F.
    """
    found = []
    for choice, pair in zip(solution.choices, scene.pairs, strict=True):
        if choice.F is None:
            found.append(np.inf)
        else:
            found.append(scene.median_distance(choice.F, pair))
    return found


def test_cameras_are_right_in_spite_of_noise_and_wrong_matches(scene):
    solution = reconstruct_batch(scene.pairs, SceneConfig())
    (found,) = solution.reconstructions
    assert (found.registered, found.failure) == (6, "")
    assert max(distances(solution, scene)) < 0.5
    # Pixel centres are at integers, so the middle of 800 pixels is at 399.5.
    middle = [SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5]
    registered = registered_images(solution)
    for image in scene.images:
        found_image = registered[image.digest]
        true_focal = scene.cameras[image.name].K[0, 0]
        assert found_image.focal == pytest.approx(true_focal, rel=0.03)
        assert found_image.camera.K[:2, 2].tolist() == middle
        assert found_image.points > 50
    (model,) = found.models
    assert 0.1 < model.reprojection_error < 1
    assert len(model.points) > 200


@pytest.mark.parametrize(("all_tracks", "most"), [(6, None), (5, 20)])
def test_a_large_scene_starts_from_a_few_tracks_of_each_image(
    scene, monkeypatch, all_tracks, most
):
    """The cameras are as right, and points of all tracks come in the end."""
    monkeypatch.setattr(colmap, "TRACKS_PER_IMAGE", 20)
    starts = []
    pipeline = colmap.pycolmap.GlobalPipeline

    def noted(options, *rest):
        starts.append(options.mapper.track_required_tracks_per_view)
        return pipeline(options, *rest)

    monkeypatch.setattr(colmap.pycolmap, "GlobalPipeline", noted)
    solution = reconstruct_batch(scene.pairs, SceneConfig(all_tracks=all_tracks))
    assert {each == most for each in starts} == {most is not None}
    assert max(distances(solution, scene)) < 1
    (found,) = solution.reconstructions
    assert len(found.models[0].points) > 6 * 20


def test_the_same_batch_gives_the_same_bytes_through_a_pipe_too(scene):
    # As a worker's process receives them.
    piped = pickle.loads(pickle.dumps(scene.pairs))
    first = reconstruct_batch(scene.pairs, SceneConfig())
    again = reconstruct_batch(piped, SceneConfig())
    assert pickle.dumps(first) == pickle.dumps(again)


def test_points_of_a_dense_matcher_make_tracks(scene):
    """Each pair has other points of the surface: a keypoint of two pairs is a coincidence within a
    cell.
    """
    rng = np.random.default_rng(3)
    pairs = []
    for pair in scene.pairs:
        world = front(rng, 4000)
        camera0, camera1 = scene.true_cameras(pair)
        seen0 = see(rng, camera0, world, 0.3)
        seen1 = see(rng, camera1, world, 0.3)
        dense = match(rng, seen0, seen1, 0.1, None)
        pairs.append(replace(pair, by_unit=(dense,)))
    solution = reconstruct_batch(pairs, SceneConfig())
    (found,) = solution.reconstructions
    assert (found.registered, found.failure) == (6, "")
    assert max(distances(solution, scene)) < 1


def test_a_pair_without_matches_gets_the_scenes_fundamental(scene):
    first, *others = scene.pairs
    few = replace(first, by_unit=(first.matches[:0],))
    # The images of this pair have cameras by their other pairs.
    solution = reconstruct_batch((few, *others), SceneConfig())
    choice = solution.choices[0]
    assert choice.from_scene
    assert scene.median_distance(choice.F, few) < 0.5


def test_a_pair_that_the_scene_lacks_is_estimated_at_its_focal_lengths(scene):
    last = scene.images[-1]
    inside = []
    outside = []
    for pair in scene.pairs:
        if last in (pair.image0, pair.image1):
            outside.append(pair)
        else:
            inside.append(pair)
    matches = outside[0].matches
    # 14 are too few to register the image, but enough for an F at a known focal length.
    few = replace(outside[0], by_unit=(matches[:14],))
    # 3 are too few for any F.
    too_few = replace(outside[0], by_unit=(matches[:3],))
    pairs = (few, too_few, *inside)
    magsac = RobustConfig(max_iterations=2000)
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
    across = BatchPair(scene.images[0], other.images[0], ())
    solution = reconstruct_batch((*scene.pairs, *other.pairs, across), SceneConfig())
    assert [found.registered for found in solution.reconstructions] == [6, 4]
    assert solution.choices[-1].reason is Reason.APART
    assert all(choice.from_scene for choice in solution.choices[:-1])


def test_a_pair_whose_matches_agree_on_something_else_keeps_its_own(scene):
    """As on a facade that repeats itself; whether it is right nobody knows, so the pair's own F
    stays.
    """
    pair = scene.pairs[-1]
    shift = np.array([0, 90], np.float32)
    shifted = replace(pair.matches, points1=pair.matches.points0 + shift)
    # F of a shift along y: its lines are the columns.
    F = np.array(
        [
            [0, 0, 1],
            [0, 0, 0],
            [-1, 0, 0],
        ]
    )
    F = F / np.sqrt(2)
    repeated = replace(pair, by_unit=(shifted,), pair_fundamental=F)
    pairs = (*scene.pairs[:-1], repeated)
    solution = reconstruct_batch(pairs, SceneConfig(), FocalConfig())
    *others, last = solution.choices
    assert (last.reason, last.F) == (Reason.CONTRADICTION, None)
    assert all(choice.from_scene for choice in others)


def test_too_few_pairs_or_matches_make_no_scene(scene):
    # Two pairs of one image: three images on a chain.
    first = scene.images[0]
    of_first = [pair for pair in scene.pairs if pair.image0 == first]
    chain = of_first[:2]
    (found,) = reconstruct_batch(chain, SceneConfig()).reconstructions
    assert found.failure == (
        "2 matched pairs connect 3 images, and reliable cameras need 5; more overlapping images would help"
    )
    (found,) = reconstruct_batch(chain[:1], SceneConfig()).reconstructions
    assert found.failure == "2 images are connected; a scene needs 3"
    unmatched = pair_of("01", Matches.empty())
    for pairs in ([], [unmatched]):
        assert reconstruct_batch(pairs, SceneConfig()).reconstructions == ()


# 60 matches: far more than the number below which a pair is ignored.
POINTS, OTHERS = np.random.default_rng(0).uniform(10, 500, (2, 60, 2))
LINE = np.column_stack([POINTS[:, 0], POINTS[:, 0]])
DEGENERATE = {
    "random": (POINTS, OTHERS),
    "a line": (LINE, LINE + 5),
    # Of a plane, or a camera that only turned.
    "a homography": (POINTS, POINTS[:, ::-1] * 0.9 + 20),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_matches_give_a_reason(kind):
    points0, points1 = DEGENERATE[kind]
    matches = Matches(points0, points1, np.ones(60))
    # Fewer pairs would not reach the mapper.
    pairs = [pair_of(names, matches) for names in ("01", "02", "03", "12", "13", "23")]
    solution = reconstruct_batch(pairs, SceneConfig())
    (found,) = solution.reconstructions
    assert found.models or found.failure
    if kind == "random":
        assert found.failure == "the matches gave no plausible model"
    for choice in solution.choices:
        assert choice.from_scene or choice.reason is not Reason.SCENE
        assert choice.F is None or np.isfinite(choice.F).all()


@pytest.mark.parametrize("is_missing", [True, False])
def test_a_missing_or_broken_pycolmap_is_a_reason(scene, monkeypatch, is_missing):
    def broken(*_: object) -> None:
        raise RuntimeError("disk I/O error")

    if is_missing:
        # Without its entry, the module is imported again, and its import of pycolmap fails.
        monkeypatch.delitem(sys.modules, "mkpc_kaggle.scene.colmap", raising=False)
        monkeypatch.setitem(sys.modules, "pycolmap", None)
        expected = "pycolmap cannot be imported"
    else:
        monkeypatch.setattr(colmap, "structure_from_motion", broken)
        expected = "pycolmap failed: disk I/O error"
    solution = reconstruct_batch(scene.pairs, SceneConfig())
    assert expected in solution.reconstructions[0].failure
    assert {choice.reason for choice in solution.choices} == {Reason.UNREGISTERED}


def test_an_edge_is_verified_once_for_the_same_cameras_on_any_number_of_threads(
    scene, monkeypatch, tmp_path
):
    calls = []
    estimate = colmap.pycolmap.estimate_two_view_geometry

    def counted(*arguments: object) -> object:
        calls.append(arguments)
        return estimate(*arguments)

    monkeypatch.setattr(colmap.pycolmap, "estimate_two_view_geometry", counted)
    # A second reconstruction with shared intrinsics would have other cameras.
    config = SceneConfig(cameras=CameraSharing.IMAGE)
    written = []
    for threads in (1, 4):
        executor = partial(ThreadPoolExecutor, threads)
        monkeypatch.setattr(colmap, "ThreadPoolExecutor", executor)
        calls.clear()
        out = tmp_path / str(threads)
        # Both the scene and its files use all geometries.
        reconstruct_batch(scene.pairs, config, folder=out)
        assert len(calls) == len(scene.pairs)
        with closing(sqlite3.connect(out / "database.db")) as database:
            dump = list(database.iterdump())
        written.append(dump)
    assert written[0] == written[1]


def test_a_refinement_without_the_matches_of_an_image_leaves_the_image_out(scene):
    whole = MergedGraph(ViewGraph.of_pairs(scene.pairs))
    first = map_graph(whole, {}, config=SceneConfig())
    assert first.registered == 6
    edges = [edge for edge in whole.graph.edges if 3 not in (edge.first, edge.second)]
    lacking = MergedGraph(replace(whole.graph, edges=tuple(edges)))
    second = map_graph(lacking, {}, first.models, config=SceneConfig())
    assert second.failure == ""
    names = {found.image.name for found in second.models[0].images}
    assert names == {*scene.cameras} - {"0003"}


def test_a_point_behind_a_camera_counts_for_nothing(scene, monkeypatch):
    adjust = colmap.adjust
    behind = []

    def adjusted(model, given_cameras):
        adjust(model, given_cameras)
        image = model.images[min(model.reg_image_ids())]
        seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
        behind.extend(seen[:20])
        for number in behind:
            point = model.points3D[number]
            point.xyz = 2 * image.projection_center() - point.xyz
        model.update_point_3d_errors()
        assert model.compute_mean_reprojection_error() > 1e100
        behind.append(len(seen) - 20)

    monkeypatch.setattr(colmap, "adjust", adjusted)
    config = SceneConfig(cameras=CameraSharing.IMAGE)
    (model,) = reconstruct_batch(scene.pairs, config).reconstructions[0].models
    assert model.images[0].points == behind[-1]
    assert model.reprojection_error < 1e6


def test_a_homography_that_was_not_estimated_is_not_read(scene, monkeypatch, tmp_path):
    """pycolmap leaves it as it was in memory."""
    estimate = colmap.pycolmap.estimate_two_view_geometry
    written = []
    filled_edges = []
    for number, value in enumerate((np.nan, 1e300)):

        def filled(*arguments: object, value: float = value, number: int = number) -> object:
            geometry = estimate(*arguments)
            if geometry.config not in colmap.WITH_HOMOGRAPHY:
                geometry.H = np.full((3, 3), value)
                filled_edges.append(number)
            return geometry

        monkeypatch.setattr(colmap.pycolmap, "estimate_two_view_geometry", filled)
        out = tmp_path / str(number)
        reconstruct_batch(scene.pairs, SceneConfig(), folder=out)
        with closing(sqlite3.connect(out / "database.db")) as database:
            written.append([*database.iterdump()])
        files = sorted((out / "models").rglob("*.bin"))
        written[-1] += [file.read_bytes() for file in files]
    assert {*filled_edges} == {0, 1}
    assert written[0] == written[1]
