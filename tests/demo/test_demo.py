"""The demo data set: its cameras, pixels and files agree with one another."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from mkpc_kaggle.demo import DemoSet, write_demo
from mkpc_kaggle.demo.camera import STEP_PX, look_at, transfer, visible_mask
from mkpc_kaggle.demo.render import Surface, render
from mkpc_kaggle.demo.world import SCENES, build_world
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
    corner = np.array([*left, high])
    edge = np.array([*right, high]) - corner
    return Surface(corner, edge, np.array([0, 0, low - high]), texture)


def test_a_view_warped_by_its_nearness_agrees_with_the_other_view():
    """Image, nearness and camera agree to a small part of a pixel; half a pixel would show."""
    texture = blobs()
    surfaces = [
        upright((-6, 9), (2, 12), -3, 5, texture),
        upright((2, 12), (8, 7), -3, 5, texture),
        upright((-0.5, 6), (1, 5.5), -2, 1, texture),
    ]
    # Rolled, and of different aspects, so that exchanged axes show.
    first = look_at((-1, 0, 1), (0, 10, 1), 420, (400, 300), roll=5)
    second = look_at((1.5, 1, 1.5), (0, 10, 1), 380, (300, 400), roll=-12)
    image_a, nearness_a = render(surfaces, first)
    image_b, nearness_b = render(surfaces, second)
    visible = visible_mask(first, nearness_a, second, nearness_b)
    pixels, _ = transfer(first, nearness_a, second)
    sampled = image_a[::STEP_PX, ::STEP_PX]

    def difference(shift: tuple[float, float]) -> float:
        maps = (pixels + shift).astype(np.float32)
        warped = cv2.remap(image_b, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
        levels = np.abs(warped - sampled)[visible]
        return float(np.median(levels))

    assert visible.mean() > 0.3
    unshifted = difference((0, 0))
    assert unshifted < 1
    # Half a pixel is the error of a renderer whose pixel centres are not at integers.
    for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
        assert difference(shift) > 3 * unshifted


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
