"""Reconstruction of small synthetic scenes: right cameras, the same bytes, and a reason whenever there is none."""

import pickle
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.scene import reconstruct
from mkpc_kaggle.scene.batch import Batch, BatchImage, BatchPair
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.config import CameraModel, Mapper, SceneConfig
from mkpc_kaggle.scene.known_focals import KnownFocals
from mkpc_kaggle.scene.model import Model
from mkpc_kaggle.scene.solve import Solution, solve

BOTH = pytest.mark.parametrize("config", [SceneConfig(mapper=mapper) for mapper in Mapper], ids=list(Mapper))


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(6, points=500)


def batch_of(count: int, *pairs: BatchPair) -> Batch:
    return Batch(tuple(BatchImage(str(n), f"digest {n}", SIZE) for n in range(count)), pairs)


def distances(solution: Solution, scene: SyntheticScene) -> list[float]:
    """How far true correspondences are from the F that each pair got, in pixels; infinite without one."""
    return [
        np.inf if choice.F is None else scene.median_distance(choice.F, pair)
        for choice, pair in zip(solution.choices, scene.batch.pairs, strict=True)
    ]


@BOTH
@pytest.mark.parametrize("camera_model", CameraModel)
def test_cameras_are_right_in_spite_of_noise_and_wrong_matches(
    scene: SyntheticScene, config: SceneConfig, camera_model: CameraModel
) -> None:
    solution = solve(scene.batch, replace(config, camera_model=camera_model))
    (one,) = solution.scenes
    assert (one.placed, one.failure, one.doubts) == (6, "", ())
    assert max(distances(solution, scene)) < 0.5
    for name, camera in scene.cameras.items():
        placed = solution.placed(name)
        assert placed is not None
        assert placed.focal == pytest.approx(camera.K[0, 0], rel=0.03)
        assert placed.camera.K[:2, 2].tolist() == [SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5]
        assert placed.points > 50
    (model,) = one.models
    assert 0.1 < model.reprojection_error < 1
    assert len(model.points) > 200


@BOTH
def test_the_same_batch_gives_the_same_bytes(scene: SyntheticScene, config: SceneConfig) -> None:
    assert pickle.dumps(solve(scene.batch, config)) == pickle.dumps(solve(scene.batch, config))


@pytest.mark.parametrize(("each_matcher", "times"), [(True, 3), (False, 1)])
def test_what_each_matcher_found_is_reconstructed_alone_too(
    scene: SyntheticScene, monkeypatch: pytest.MonkeyPatch, each_matcher: bool, times: int
) -> None:
    called: list[int] = []

    def note(names: Sequence[str], *rest: Any) -> tuple[Model, ...]:
        called.append(len(names))
        return made(names, *rest)

    made = reconstruct.reconstruct
    monkeypatch.setattr(reconstruct, "reconstruct", note)
    halves = [
        replace(pair, tracks={"even": pair.matches[::2], "odd": pair.matches[1::2]}) for pair in scene.batch.pairs
    ]
    solution = solve(replace(scene.batch, pairs=tuple(halves)), SceneConfig(each_matcher=each_matcher))
    assert called == [6] * times
    assert len(solution.scenes) == 1
    assert max(distances(solution, scene)) < 0.5


def test_a_solution_goes_through_a_pipe(scene: SyntheticScene) -> None:
    solution = solve(pickle.loads(pickle.dumps(scene.batch)), SceneConfig())
    copy = pickle.loads(pickle.dumps(solution))
    assert [choice.reason for choice in copy.choices] == [choice.reason for choice in solution.choices]
    np.testing.assert_array_equal(copy.scenes[0].models[0].points, solution.scenes[0].models[0].points)


def test_a_pair_with_few_matches_of_its_own_gets_the_scenes_fundamental(scene: SyntheticScene) -> None:
    pairs = list(scene.batch.pairs)
    pairs[0] = replace(pairs[0], matches=pairs[0].matches[:3])
    solution = solve(replace(scene.batch, pairs=tuple(pairs)), SceneConfig())
    assert solution.choices[0].from_scene
    assert scene.median_distance(solution.choices[0].F, pairs[0]) < 0.5


def test_a_pair_without_matches_gets_the_scenes_fundamental(scene: SyntheticScene) -> None:
    pairs = (replace(scene.batch.pairs[3], matches=Matches.empty()), *scene.batch.pairs)
    assert solve(replace(scene.batch, pairs=pairs), SceneConfig()).choices[0].from_scene


def test_a_pair_that_the_scene_lacks_is_estimated_at_its_focal_lengths(scene: SyntheticScene) -> None:
    last = scene.batch.images[-1].name
    inside = [pair for pair in scene.batch.pairs if last not in (pair.image0, pair.image1)]
    outside = next(pair for pair in scene.batch.pairs if last in (pair.image0, pair.image1))
    few = replace(outside, matches=outside.matches[:14])  # too few to place the image
    batch = replace(scene.batch, pairs=(few, replace(few, matches=few.matches[:3]), *inside))
    known = KnownFocals(RobustConfig(permutations=1, max_iterations=2000), FocalConfig(), sigma=0.05)
    solution = solve(batch, SceneConfig(), known)
    found, hopeless, *others = solution.choices
    assert (found.reason, found.from_scene) == (Reason.UNPLACED, False)
    assert scene.median_distance(found.F, few) < 5
    assert (hopeless.reason, hopeless.F) == (Reason.UNPLACED, None)
    assert all(choice.from_scene for choice in others)
    assert solve(batch, SceneConfig()).choices[0].F is None


def test_a_turned_pair_gets_the_transposed_fundamental(scene: SyntheticScene) -> None:
    pair = scene.batch.pairs[0]
    back = BatchPair(pair.image1, pair.image0, Matches.empty())
    solution = solve(replace(scene.batch, pairs=(*scene.batch.pairs, back)), SceneConfig())
    there, back_again = solution.choices[0].F, solution.choices[-1].F
    assert abs(np.sum(there * back_again.T)) == pytest.approx(1)


def test_a_picture_under_two_names_is_one_camera(scene: SyntheticScene) -> None:
    images = (*scene.batch.images, replace(scene.batch.images[0], name="again"))
    pair = scene.batch.pairs[0]
    pairs = (*scene.batch.pairs, replace(pair, image0="again"), BatchPair("again", "0000", pair.matches))
    solution = solve(Batch(images, pairs), SceneConfig())
    assert len(solution.scenes[0].names) == 6
    assert solution.placed("again") is solution.placed("0000")
    np.testing.assert_array_equal(solution.choices[-2].F, solution.choices[0].F)
    assert solution.choices[-1].reason is Reason.SAME_IMAGE


def test_two_places_in_a_batch_are_two_scenes(scene: SyntheticScene) -> None:
    other = synthetic_scene(4, points=500, seed=7, prefix="b")
    across = BatchPair("0000", "b0000", Matches.empty())
    both = Batch(scene.batch.images + other.batch.images, (*scene.batch.pairs, *other.batch.pairs, across))
    solution = solve(both, SceneConfig())
    assert [one.placed for one in solution.scenes] == [6, 4]
    assert solution.choices[-1].reason is Reason.APART
    assert all(choice.from_scene for choice in solution.choices[:-1])


def test_a_pair_whose_matches_agree_on_something_else_keeps_its_own(scene: SyntheticScene) -> None:
    """As on a facade that repeats itself; whether it is right nobody knows, so the pair's own F stays."""
    pair = scene.batch.pairs[-1]
    shifted = replace(pair.matches, points1=pair.matches.points0 + np.array([0, 90], np.float32))
    columns = np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]) / np.sqrt(2)
    pairs = (*scene.batch.pairs[:-1], replace(pair, matches=shifted, own=columns))
    solution = solve(replace(scene.batch, pairs=pairs), SceneConfig())
    assert solution.choices[-1].reason is Reason.CONTRADICTION
    assert all(choice.from_scene for choice in solution.choices[:-1])


def test_two_images_are_no_scene(scene: SyntheticScene) -> None:
    pair = scene.batch.pairs[0]
    solution = solve(Batch(scene.batch.images[:2], (pair,)), SceneConfig())
    assert [one.failure for one in solution.scenes] == ["2 images are connected; a scene needs 3"]
    assert solution.choices[0].reason is Reason.UNPLACED


def test_a_scene_of_too_few_pairs_is_none(scene: SyntheticScene) -> None:
    two = tuple(pair for pair in scene.batch.pairs if pair.image0 == scene.batch.pairs[0].image0)[:2]
    (one,) = solve(Batch(scene.batch.images, two), SceneConfig()).scenes
    assert one.failure == "2 pairs connect 3 images; a scene needs 1.35 an image"


def test_a_batch_without_matches_has_no_scene() -> None:
    assert solve(batch_of(0), SceneConfig()).scenes == ()
    solution = solve(batch_of(3, BatchPair("0", "1", Matches.empty())), SceneConfig())
    assert solution.scenes == ()
    assert solution.placed("0") is None


def junk(kind: str, count: int = 60) -> Matches:
    rng = np.random.default_rng(0)
    points = rng.uniform(10, 500, (count, 2))
    match kind:
        case "random":
            return Matches(points, rng.uniform(10, 500, (count, 2)), np.ones(count))
        case "one point":
            return Matches(np.full((count, 2), 50.0), np.full((count, 2), 60.0), np.ones(count))
        case "a line":
            line = np.column_stack([points[:, 0], points[:, 0]])
            return Matches(line, line + 5, np.ones(count))
        case "the same places":
            return Matches(points, points, np.ones(count))
        case _:  # a plane, or a camera that only turned
            return Matches(points, points[:, ::-1] * 0.9 + 20, np.ones(count))


@BOTH
@pytest.mark.parametrize("kind", ["random", "one point", "a line", "the same places", "a homography"])
def test_degenerate_matches_give_a_reason(kind: str, config: SceneConfig) -> None:
    pairs = [BatchPair(a, b, junk(kind)) for a, b in (("0", "1"), ("1", "2"), ("0", "2"), ("2", "3"))]
    solution = solve(batch_of(4, *pairs), config)
    (one,) = solution.scenes
    assert one.models or one.failure
    for choice in solution.choices:
        assert choice.from_scene or choice.reason is not Reason.SCENE
        assert choice.F is None or np.isfinite(choice.F).all()


@BOTH
def test_a_chain_of_images_is_a_legal_graph(config: SceneConfig) -> None:
    """Every image is in two pairs only: no point need be in three images."""
    scene = synthetic_scene(6, points=500)
    chain = tuple(p for p in scene.batch.pairs if int(p.image1) - int(p.image0) == 1)
    solution = solve(replace(scene.batch, pairs=chain), config)
    assert len(solution.choices) == 5
    assert solution.scenes[0].models or solution.scenes[0].failure


def test_without_pycolmap_every_scene_says_so(scene: SyntheticScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mkpc_kaggle.scene.reconstruct", raising=False)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    solution = solve(scene.batch, SceneConfig())
    assert "pycolmap cannot be imported" in solution.scenes[0].failure
    assert {choice.reason for choice in solution.choices} == {Reason.UNPLACED}


def test_what_pycolmap_raises_is_a_reason(scene: SyntheticScene, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("disk I/O error")

    monkeypatch.setattr("mkpc_kaggle.scene.reconstruct.reconstruct", broken)
    (one,) = solve(scene.batch, SceneConfig()).scenes
    assert one.failure == "pycolmap failed: disk I/O error"


def test_many_images_are_reconstructed_in_parts() -> None:
    large = synthetic_scene(14, points=500)
    solution = solve(large.batch, SceneConfig(most_images=8))
    placed = {image.name for model in solution.scenes[0].models for image in model.images}
    assert len(placed) >= 12
    got = [distance for distance in distances(solution, large) if np.isfinite(distance)]
    assert len(got) > 60
    assert np.median(got) < 0.5
