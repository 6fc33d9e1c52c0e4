"""One camera for many images: seen by their focal lengths, and kept only if it explains the matches."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.geometry.cameras import Camera, relative_pose
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.scene import reconstruct
from mkpc_kaggle.scene.batch import BatchImage
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.known_focals import KnownFocals, focal_of
from mkpc_kaggle.scene.model import Model, PlacedImage
from mkpc_kaggle.scene.one_camera import OneCamera, one_cameras
from mkpc_kaggle.scene.solve import Solution, solve

WIDE, TALL = Size(800, 600), Size(600, 800)
FOCAL = 840.0
CONFIG = SceneConfig()
OWN = SceneConfig(one_camera=0)


def model(*images: tuple[Size, float, int]) -> Model:
    """Images "0", "1", ... of a size, a focal length and a number of points."""
    placed = [
        PlacedImage(str(number), size, Camera(np.diag([focal, focal, 1.0]), np.eye(3), np.zeros(3)), points)
        for number, (size, focal, points) in enumerate(images)
    ]
    return Model(tuple(placed), np.zeros((0, 3)), 0.5)


def batch_images(count: int, size: Size = WIDE) -> list[BatchImage]:
    return [BatchImage(str(number), str(number), size) for number in range(count)]


def cameras(*focals: float, points: Sequence[int] = ()) -> dict[Size, OneCamera]:
    found = model(
        *((WIDE, focal, seen) for focal, seen in zip(focals, points or [100] * len(focals), strict=True))
    )
    return dict(one_cameras(batch_images(len(focals)), [found], CONFIG))


def test_most_images_of_a_size_tell_its_focal_length() -> None:
    assert cameras(838, 839, 840, 841, 842) == {WIDE: OneCamera(840, frozenset("01234"))}


def test_an_image_with_few_points_is_by_the_same_camera_whatever_its_focal_length() -> None:
    found = cameras(838, 840, 841, 2900, 880, points=(100, 100, 100, 4, 49))
    assert found == {WIDE: OneCamera(841, frozenset("01234"))}


def test_an_image_with_many_points_and_another_focal_length_was_taken_at_another_zoom() -> None:
    found = cameras(838, 840, 841, 420, 842, points=(100, 100, 100, 90, 100))
    assert found == {WIDE: OneCamera(840, frozenset("0124"))}


def test_an_image_without_a_camera_counts_if_others_of_its_size_have_one() -> None:
    images = [*batch_images(6), BatchImage("tall", "tall", TALL)]
    found = one_cameras(images, [model(*[(WIDE, FOCAL, 100)] * 5)], CONFIG)
    assert found == {WIDE: OneCamera(FOCAL, frozenset("012345"))}


def test_an_image_in_two_models_counts_once() -> None:
    models = [model(*[(WIDE, FOCAL, 100)] * 4)] * 2
    assert one_cameras(batch_images(4), models, CONFIG) == {}


@pytest.mark.parametrize(
    "focals",
    [(), (FOCAL,) * 4, (840, 840, 840, 900, 900, 900), (600, 700, 840, 950, 1100), (-840,) * 3 + (np.nan,) * 3],
    ids=["none", "few", "half", "strangers", "absurd"],
)
def test_where_fewer_agree_there_is_no_one_camera(focals: tuple[float, ...]) -> None:
    assert cameras(*focals) == {}


def test_few_images_of_each_of_two_sizes_are_few() -> None:
    found = model(*[(WIDE, FOCAL, 100)] * 3, *[(TALL, FOCAL, 100)] * 3)
    assert one_cameras([*batch_images(3), *batch_images(6, TALL)[3:]], [found], CONFIG) == {}


def test_zero_turns_it_off() -> None:
    found = model(*((WIDE, focal, 100) for focal in (838.0, 839, 840, 841, 842)))
    assert one_cameras(batch_images(5), [found], OWN) == {}
    unmoved = model(*[(WIDE, FOCAL, 100)] * 5)  # the prior's, in all of them
    assert one_cameras(batch_images(5), [unmoved], OWN) == {}


def focals_of(solution: Solution) -> list[float]:
    return [image.focal for one in solution.scenes for found in one.models for image in found.images]


def mean_angle(solution: Solution, scene: SyntheticScene) -> float:
    """Between the found and the true direction from one image to the other, in degrees."""
    angles = []
    for pair in scene.batch.pairs:
        placed = [solution.placed(name).camera for name in (pair.image0, pair.image1)]
        true = [scene.cameras[name] for name in (pair.image0, pair.image1)]
        found, wanted = (relative_pose(*both)[1] for both in (placed, true))
        angles.append(np.degrees(np.arccos(found @ wanted / np.linalg.norm(found) / np.linalg.norm(wanted))))
    return float(np.mean(angles))


def test_a_scene_by_one_camera_is_nearer_to_the_truth() -> None:
    scene = synthetic_scene(7, 12, points=250, noise=1.0, focals=[FOCAL] * 7)
    own, shared = solve(scene.batch, OWN), solve(scene.batch, CONFIG)
    assert len(set(focals_of(own))) == 7
    (focal,) = set(focals_of(shared))
    assert focal == pytest.approx(FOCAL, rel=0.01)
    assert mean_angle(shared, scene) < 0.6 * mean_angle(own, scene)


def test_images_at_another_zoom_keep_a_camera_of_their_own() -> None:
    scene = synthetic_scene(8, points=400, focals=[FOCAL] * 6 + [0.6 * FOCAL, 1.5 * FOCAL])
    found = solve(scene.batch, CONFIG)
    assert len(set(focals_of(found))) == 3
    for name, camera in scene.cameras.items():
        assert found.placed(name).focal == pytest.approx(camera.K[0, 0], rel=0.02)


def test_one_camera_that_explains_fewer_points_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = synthetic_scene(6, points=300)
    everything = OneCamera(FOCAL, frozenset(scene.cameras))
    monkeypatch.setattr("mkpc_kaggle.scene.solve.one_cameras", lambda *_: {SIZE: everything})
    assert len(set(focals_of(solve(scene.batch, CONFIG)))) == 6
    forced = solve(scene.batch, replace(CONFIG, one_camera_points=0))
    assert len(set(focals_of(forced))) == 1


def test_what_each_matcher_found_has_the_one_camera_too(monkeypatch: pytest.MonkeyPatch) -> None:
    known: list[bool] = []
    made = reconstruct.reconstruct

    def note(*given: Any) -> tuple[Model, ...]:
        known.append(bool(given[-1]))
        return made(*given)

    monkeypatch.setattr(reconstruct, "reconstruct", note)
    scene = synthetic_scene(6, points=500, focals=[FOCAL] * 6)
    pairs = [replace(p, tracks={"even": p.matches[::2], "odd": p.matches[1::2]}) for p in scene.batch.pairs]
    solve(replace(scene.batch, pairs=tuple(pairs)), CONFIG)
    assert known == [False, True, True, True]


def test_an_image_that_the_scene_lacks_has_the_one_cameras_focal_length() -> None:
    placed, unseen, zoomed = model((WIDE, 850.0, 100)), BatchImage("9", "", WIDE), BatchImage("8", "", WIDE)
    known = {WIDE: OneCamera(FOCAL, frozenset("09"))}
    images = (batch_images(1)[0], unseen, zoomed)
    assert [focal_of([placed], known, image) for image in images] == [850, FOCAL, None]
    pair = synthetic_scene(2, points=300, focals=[FOCAL] * 2).batch.pairs[0]
    focals = KnownFocals(RobustConfig(permutations=1, max_iterations=2000), FocalConfig(), sigma=0.05)
    assert focals.fundamental([], known, unseen, unseen, pair.matches) is not None
    assert focals.fundamental([], {}, unseen, unseen, pair.matches) is None
