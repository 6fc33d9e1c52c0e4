"""The demo data set: its cameras, pixels and files agree with one another."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import contents

from mkpc_kaggle.demo import DemoSet, write_demo
from mkpc_kaggle.demo.camera import covisibility, look_at, project, unproject, visible_mask
from mkpc_kaggle.demo.render import render
from mkpc_kaggle.demo.world import SCENES, build_world, quad
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras

# Scenes at a fifth of their size: nothing below depends on resolution.
SCALE = 0.2


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> DemoSet:
    return write_demo(tmp_path_factory.mktemp("demo"), image_scale=SCALE)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(text: str, *shape: int) -> np.ndarray:
    values = [float(word) for word in text.split(" ")]
    return np.array(values).reshape(shape)


def blobs():
    """Blobs of about 16 texels: the intensity changes fast enough to show half a pixel."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (32, 32, 3)).astype(np.uint8)
    return cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)


def upright(
    left: tuple[float, float],
    right: tuple[float, float],
    low: float,
    high: float,
    texture: np.ndarray,
):
    """A wall between two points of the ground (x, y), from a height ``low`` to ``high``."""
    top_left = (*left, high)
    top_right = (*right, high)
    bottom_left = (*left, low)
    return quad(top_left, top_right, bottom_left, texture)


def test_a_view_warped_by_its_depth_agrees_with_the_other_view():
    """Image, depth and camera agree to a small part of a pixel; half a pixel would show."""
    texture = blobs()
    surfaces = [
        upright((-6, 9), (2, 12), -3, 5, texture),
        upright((2, 12), (8, 7), -3, 5, texture),
        upright((-0.5, 6), (1, 5.5), -2, 1, texture),
    ]
    # Rolled, and of different aspects, so that exchanged axes show.
    first = look_at((-1, 0, 1), (0, 10, 1), 420, (400, 300), roll=5)
    second = look_at((1.5, 1, 1.5), (0, 10, 1), 380, (300, 400), roll=-12)
    image_a, depth_a = render(surfaces, first)
    image_b, depth_b = render(surfaces, second)
    visible = visible_mask(first, depth_a, second, depth_b)
    y, x = np.nonzero(visible)
    pixels_a = np.column_stack([x, y]).astype(float)
    depths = depth_a[y, x].astype(float)
    points = unproject(first, pixels_a, depths)
    pixels, _ = project(second, points)

    def difference(shift: tuple[float, float]) -> float:
        maps = np.zeros((*depth_a.shape, 2), dtype=np.float32)
        maps[y, x] = pixels + np.array(shift)
        columns = maps[..., 0]
        lines = maps[..., 1]
        warped = cv2.remap(image_b, columns, lines, cv2.INTER_LINEAR)
        levels = np.abs(warped[y, x] - image_a[y, x])
        return float(np.median(levels))

    assert len(y) > 0.3 * depth_a.size
    unshifted = difference((0, 0))
    assert unshifted < 1
    # Half a pixel is the error of a renderer whose pixel centres are not at integers.
    for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
        assert difference(shift) > 3 * unshifted


def test_covisibility_counts_the_shared_half_of_a_wall_but_no_sky_and_no_hidden_points():
    # A view is 10 m wide at the wall; half of that is a baseline of 5 m.
    a = look_at((0.0, 0, 0), (0.0, 10, 0), 200, (200, 150))
    b = look_at((5.0, 0, 0), (5.0, 10, 0), 200, (200, 150))
    texture = blobs()
    wall = upright((-50, 10), (50, 10), -50, 50, texture)
    # 2 m before the second camera, it fills that view.
    screen = upright((3, 2), (7, 2), -50, 50, texture)
    cases = [
        ([wall], 0.5),
        ([wall, screen], 0),
        ([], 0),
    ]
    for surfaces, shared in cases:
        _, depth_a = render(surfaces, a)
        _, depth_b = render(surfaces, b)
        found = covisibility(a, depth_a, b, depth_b)
        # A view has 200 columns, so a border that is one column off costs 0.005.
        assert found == pytest.approx(shared, abs=0.02)
        assert found == covisibility(b, depth_b, a, depth_a)


@pytest.mark.parametrize("scene_name", SCENES)
def test_fundamental_matrices_and_pictures_are_those_of_the_cameras(small_demo, scene_name):
    train = small_demo.train_dir / scene_name
    cameras = {}
    for row in rows(train / "calibration.csv"):
        K = numbers(row["camera_intrinsics"], 3, 3)
        R = numbers(row["rotation_matrix"], 3, 3)
        t = numbers(row["translation_vector"], 3)
        cameras[row["image_id"]] = Camera(K, R, t)
    for row in rows(train / "pair_covisibility.csv"):
        name0, name1 = row["pair"].split("-")
        F = fundamental_of_cameras(cameras[name0], cameras[name1])
        written = numbers(row["fundamental_matrix"], 3, 3)
        np.testing.assert_allclose(written, F, atol=1e-9)
    _, placed = build_world(scene_name, image_scale=SCALE)
    for name, camera in zip(sorted(cameras), placed, strict=True):
        np.testing.assert_allclose(cameras[name].K, camera.K, atol=1e-9)
        np.testing.assert_allclose(cameras[name].R, camera.R, atol=1e-9)
        picture = cv2.imread(str(train / "images" / f"{name}.jpg"))
        height, width, _ = picture.shape
        assert (width, height) == (camera.width, camera.height)


def test_the_test_side_has_covisible_pairs_of_renamed_train_images(small_demo):
    samples = rows(small_demo.test_dir / "test.csv")
    truths = rows(small_demo.truth_csv)
    assert len({row["sample_id"] for row in samples}) == 8 * len(SCENES)
    for row, truth in zip(samples, truths, strict=True):
        batch = row["batch_id"]
        hidden = [row["image_1_id"], row["image_2_id"]]
        names = [truth["image_1_id"], truth["image_2_id"]]
        assert row["sample_id"] == truth["sample_id"]
        assert row["sample_id"] == f"{truth['scene']};{batch};{'-'.join(hidden)}"
        train = small_demo.train_dir / truth["scene"]
        table = rows(train / "pair_covisibility.csv")
        # The two images of a pair may be exchanged.
        (pair,) = (each for each in table if set(each["pair"].split("-")) == set(names))
        # The competition's lower limit.
        assert float(pair["covisibility"]) >= 0.1
        for image, name in zip(hidden, names, strict=True):
            tested = small_demo.test_dir / "test_images" / batch / f"{image}.png"
            png = cv2.imread(str(tested))
            jpg = cv2.imread(str(train / "images" / f"{name}.jpg"))
            assert png.shape == jpg.shape
            difference = np.abs(png.astype(int) - jpg).mean()
            # Grey levels of JPEG's loss: the train side is stored as JPEG, the test side as PNG.
            assert difference < 6, "the same picture"


def test_the_street_has_wide_photographs_and_lenses_of_two_and_four_times_their_focal_length(
    small_demo,
):
    street = small_demo.train_dir / "street"
    focal = {}
    for row in rows(street / "calibration.csv"):
        K = numbers(row["camera_intrinsics"], 3, 3)
        # Over the image's width: the principal point is its centre.
        focal[row["image_id"]] = K[0, 0] / K[0, 2]
    ratios = []
    for row in rows(street / "pair_covisibility.csv"):
        first, second = row["pair"].split("-")
        is_wide = [name in {"street_0000", "street_0001"} for name in (first, second)]
        if is_wide == [False, True]:
            ratios.append(focal[first] / focal[second])
            # A lens of four times the focal length shows at most a sixteenth of the wide photograph.
            assert float(row["covisibility"]) > 0.02
    np.testing.assert_allclose(sorted(ratios), 8 * [2.0] + 8 * [4.0], rtol=0.02)


def test_a_scene_has_the_same_bytes_with_and_without_the_other_scenes(tmp_path, small_demo):
    alone = write_demo(tmp_path, scenes=["market"], image_scale=SCALE)
    scenes = [path.name for path in alone.train_dir.iterdir() if path.is_dir()]
    assert scenes == ["market"]
    market = contents(alone.train_dir / "market")
    assert market == contents(small_demo.train_dir / "market")
    of_all = contents(small_demo.test_dir / "test_images")
    of_market = contents(alone.test_dir / "test_images")
    assert of_market.items() <= of_all.items()
