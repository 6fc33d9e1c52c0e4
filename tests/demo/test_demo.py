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

SCALE = 0.2


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> DemoSet:
    return write_demo(tmp_path_factory.mktemp("demo"), image_scale=SCALE)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(text: str, *shape: int) -> np.ndarray:
    return np.array([float(word) for word in text.split(" ")]).reshape(shape)


def blobs():
    """Blobs of some 16 texels: the intensity changes fast enough to show half a pixel."""
    noise = np.random.default_rng(0).uniform(0, 255, (32, 32, 3)).astype(np.uint8)
    return cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)


def upright(
    left: tuple[float, float],
    right: tuple[float, float],
    low: float,
    high: float,
    texture: np.ndarray,
):
    return quad((*left, high), (*right, high), (*left, low), texture)


def test_a_view_warped_by_depth_falls_on_the_other():
    """Image, depth and camera agree to a small part of a pixel; half a pixel would show."""
    texture = blobs()
    surfaces = [
        upright((-6, 9), (2, 12), -3, 5, texture),
        upright((2, 12), (8, 7), -3, 5, texture),
        upright((-0.5, 6), (1, 5.5), -2, 1, texture),
    ]
    first = look_at((-1, 0, 1), (0, 10, 1), 420, (400, 300), roll=5)
    second = look_at((1.5, 1, 1.5), (0, 10, 1), 380, (300, 400), roll=-12)
    (image_a, depth_a), (image_b, depth_b) = (
        render(surfaces, camera) for camera in (first, second)
    )
    y, x = np.nonzero(visible_mask(first, depth_a, second, depth_b))
    points = unproject(first, np.column_stack([x, y]).astype(float), depth_a[y, x].astype(float))
    pixels, _ = project(second, points)

    def difference(shift: tuple[float, float]) -> float:
        maps = np.zeros((*depth_a.shape, 2), dtype=np.float32)
        maps[y, x] = pixels + np.array(shift)
        warped = cv2.remap(image_b, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
        return float(np.median(np.abs(warped[y, x] - image_a[y, x])))

    assert len(y) > 0.3 * depth_a.size
    assert difference((0, 0)) < 1
    assert min(
        difference(shift) for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))
    ) > 3 * difference((0, 0))


def test_two_views_share_half_of_a_wall_and_neither_sky_nor_what_a_screen_hides():
    # A view is 10 m wide at the wall; half of that is a baseline of 5 m.
    a, b = (look_at((x, 0, 0), (x, 10, 0), 200, (200, 150)) for x in (0.0, 5.0))
    wall, screen = (
        upright((x - w, y), (x + w, y), -50, 50, blobs()) for x, y, w in ((0, 10, 50), (5, 2, 2))
    )
    for surfaces, shared in (([wall], 0.5), ([wall, screen], 0), ([], 0)):
        (_, depth_a), (_, depth_b) = (render(surfaces, camera) for camera in (a, b))
        assert covisibility(a, depth_a, b, depth_b) == pytest.approx(shared, abs=0.02)
        assert covisibility(a, depth_a, b, depth_b) == covisibility(b, depth_b, a, depth_a)


@pytest.mark.parametrize("scene_name", SCENES)
def test_fundamental_matrices_and_pictures_are_those_of_the_cameras(small_demo, scene_name):
    train = small_demo.train_dir / scene_name
    cameras = {}
    for row in rows(train / "calibration.csv"):
        K, R = (numbers(row[name], 3, 3) for name in ("camera_intrinsics", "rotation_matrix"))
        cameras[row["image_id"]] = Camera(K, R, numbers(row["translation_vector"], 3))
    for row in rows(train / "pair_covisibility.csv"):
        F = fundamental_of_cameras(*(cameras[name] for name in row["pair"].split("-")))
        np.testing.assert_allclose(numbers(row["fundamental_matrix"], 3, 3), F, atol=1e-9)
    for name, camera in zip(
        sorted(cameras), build_world(scene_name, image_scale=SCALE)[1], strict=True
    ):
        np.testing.assert_allclose(
            [*cameras[name].K, *cameras[name].R], [*camera.K, *camera.R], atol=1e-9
        )
        assert cv2.imread(str(train / "images" / f"{name}.jpg")).shape[1::-1] == (
            camera.width,
            camera.height,
        )


def test_the_test_side_has_covisible_pairs_of_renamed_train_images(small_demo):
    samples, truths = rows(small_demo.test_dir / "test.csv"), rows(small_demo.truth_csv)
    assert len({row["sample_id"] for row in samples}) == 8 * len(SCENES)
    for row, truth in zip(samples, truths, strict=True):
        batch, *hidden = row["batch_id"], row["image_1_id"], row["image_2_id"]
        names = truth["image_1_id"], truth["image_2_id"]
        assert (
            row["sample_id"] == truth["sample_id"] == f"{truth['scene']};{batch};{'-'.join(hidden)}"
        )
        train = small_demo.train_dir / truth["scene"]
        table = rows(train / "pair_covisibility.csv")
        (pair,) = (each for each in table if set(each["pair"].split("-")) == set(names))
        assert float(pair["covisibility"]) >= 0.1
        for image, name in zip(hidden, names, strict=True):
            png = cv2.imread(str(small_demo.test_dir / "test_images" / batch / f"{image}.png"))
            jpg = cv2.imread(str(train / "images" / f"{name}.jpg"))
            assert png.shape == jpg.shape
            assert np.abs(png.astype(int) - jpg).mean() < 6, "the same picture"


def test_same_seed_same_bytes_whatever_the_other_scenes(tmp_path, small_demo):
    alone = write_demo(tmp_path, scenes=["market"], image_scale=SCALE)
    assert [path.name for path in alone.train_dir.iterdir() if path.is_dir()] == ["market"]
    assert contents(alone.train_dir / "market") == contents(small_demo.train_dir / "market")
    of_all = contents(small_demo.test_dir / "test_images")
    assert contents(alone.test_dir / "test_images").items() <= of_all.items()
