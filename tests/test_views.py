"""The benchmark of what matchers find on whole images and on critical regions."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import views
from benchmarks.views import Seen, Views, look, recipe_of, table
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import Image
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.geometry.cameras import relative_pose
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.two_stage import to_image


@pytest.fixture(scope="module")
def scene(demo: DemoSet) -> TrainScene:
    (scene,) = read_train_side(demo.train_dir, pairs_per_scene=3)
    return scene


def images_of(true: TruePair) -> tuple[Image, Image]:
    image0, image1 = map(to_image, true.pair.images)
    return image0, image1


def seen_points(true: TruePair, size: Size, count: int = 200) -> Matches:
    """Points in space that both cameras see, where they see them."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (size.width - 1, size.height - 1), (count, 2))
    rays = np.column_stack([pixels, np.ones(count)]) @ np.linalg.inv(true.camera0.K).T
    rotation, translation = relative_pose(true.camera0, true.camera1)
    scale = np.linalg.norm(translation)
    other = (rays * rng.uniform(5, 20, (count, 1)) * scale) @ rotation.T + translation
    projected = other @ true.camera1.K.T
    return Matches(pixels, projected[:, :2] / projected[:, 2:], np.ones(count))


def test_true_matches_are_right_cover_the_image_and_lie_on_no_plane(scene: TrainScene) -> None:
    true = scene.pairs[0]
    image0, image1 = images_of(true)
    matches = seen_points(true, image0.size)
    seen = Seen.of(matches, true, (image0, image1))
    assert (seen.matches, seen.right) == (200, 1.0)
    assert seen.error < 0.01
    assert seen.cover > 0.5
    assert seen.plane < 0.9
    quarter = matches[(matches.points0 < (image0.size.width / 2, image0.size.height / 2)).all(axis=1)]
    assert Seen.of(quarter, true, (image0, image1)).cover < seen.cover


def test_wrong_matches_are_told_and_none_are_legal(scene: TrainScene) -> None:
    true = scene.pairs[0]
    images = images_of(true)
    matches = seen_points(true, images[0].size)
    rng = np.random.default_rng(1)
    wrong = Matches(matches.points0, rng.permutation(matches.points1), matches.scores)
    assert Seen.of(wrong, true, images).right < 0.2
    none = Seen.of(Matches.empty(), true, images)
    assert none.matches == none.cover == 0
    assert np.isnan(none.error)


def test_a_pair_is_looked_at_both_ways_and_scenes_are_tabled(
    scene: TrainScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(views, "LONG_SIDES", {"sift": (480, 400)})
    pipeline = assemble(recipe_of("sift")).pipeline()
    found = [look(images_of(true), true, pipeline) for true in scene.pairs]
    one = next(view for view in found if view is not None)
    assert one.enlarged > 1
    assert one.crop.matches > 20
    assert one.whole.right > 0.5
    same = Views(one.whole, replace(one.whole, matches=2 * one.whole.matches), 2.0)
    rows = list(table({"a": [same, None], "b": [None]}))
    assert rows[2].startswith(f"| a | 2 | 1 | 2.0 | {one.whole.matches:.0f} -> {2 * one.whole.matches:.0f} |")
    assert rows[3] == "| b | 1 | 0 | | | | | | |"
