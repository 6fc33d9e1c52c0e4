"""The demo data set: its cameras, pixels and files agree with one another."""

import csv
import hashlib
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from mkpc_kaggle.demo import (
    SCENE_NAMES,
    Camera,
    DemoSet,
    Scene,
    View,
    build_scene,
    covisibility,
    look_at,
    project,
    render,
    resized,
    unproject,
    visible_share,
    write_demo,
)
from mkpc_kaggle.demo.covisibility import visible_mask
from mkpc_kaggle.demo.photographs import Photographs, load_photographs
from mkpc_kaggle.demo.scene import in_units
from mkpc_kaggle.demo.surface import box, slab, wall
from mkpc_kaggle.demo.texture import mipmap, sample
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras

SCALE = 0.2


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoSet:
    return write_demo(tmp_path_factory.mktemp("demo"), image_scale=SCALE)


@pytest.fixture(scope="module")
def photographs() -> Photographs:
    return load_photographs()


@pytest.fixture(scope="module")
def scenes(photographs: Photographs) -> dict[str, Scene]:
    return {name: build_scene(name, photographs, image_scale=SCALE) for name in SCENE_NAMES}


@pytest.fixture(scope="module")
def depths(scenes: dict[str, Scene]) -> dict[str, list[tuple[Camera, np.ndarray]]]:
    """Of each scene the cameras and the depth maps, rendered anew."""
    return {name: [(view.camera, scene.render(view)[1]) for view in scene.views] for name, scene in scenes.items()}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(text: str, *shape: int) -> np.ndarray:
    return np.array([float(word) for word in text.split(" ")]).reshape(shape)


def cameras_of(demo: DemoSet, scene: str) -> dict[str, Camera]:
    cameras = {}
    for row in rows(demo.train_dir / scene / "calibration.csv"):
        picture = cv2.imread(str(demo.train_dir / scene / "images" / f"{row['image_id']}.jpg"))
        cameras[row["image_id"]] = Camera(
            numbers(row["camera_intrinsics"], 3, 3),
            numbers(row["rotation_matrix"], 3, 3),
            numbers(row["translation_vector"], 3),
            picture.shape[1],
            picture.shape[0],
        )
    return cameras


def bytes_of(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def smooth_texture(seed: int = 0) -> np.ndarray:
    """Blobs of some 16 texels: the intensity changes fast enough to show half a pixel."""
    noise = np.random.default_rng(seed).uniform(0, 255, (32, 32, 3)).astype(np.uint8)
    return cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)


# Cameras


def test_look_at_puts_the_target_in_the_middle_and_world_up_upwards() -> None:
    camera = look_at((1, 2, 1.5), (4, 9, 3), focal=500, width=640, height=480)
    pixels, depth = project(camera, np.array([[4, 9, 3], [4, 9, 3.5]], dtype=float))
    assert np.allclose(pixels[0], (319.5, 239.5))
    assert pixels[1, 0] == pytest.approx(319.5)
    assert pixels[1, 1] < 239.5
    assert (depth > 0).all()
    assert np.allclose(camera.R @ camera.R.T, np.eye(3))
    assert np.linalg.det(camera.R) == pytest.approx(1)
    assert np.allclose(camera.centre, (1, 2, 1.5))


def test_roll_turns_the_camera_clockwise() -> None:
    rolled = look_at((0, 0, 0), (0, 5, 0), focal=500, width=640, height=480, roll=90)
    pixels, _ = project(rolled, np.array([[1.0, 5, 0]]))
    assert np.allclose(pixels[0], (319.5, 239.5 - 100)), "what was on the right is now above"


def test_unproject_is_the_inverse_of_project() -> None:
    camera = look_at((1, 2, 1.5), (4, 9, 3), focal=500, width=640, height=480, roll=20)
    points = np.random.default_rng(0).uniform((-5, 8, -2), (9, 20, 6), (50, 3))
    assert np.allclose(unproject(camera, *project(camera, points)), points)


def test_a_resized_camera_keeps_pixel_centres_where_they_are() -> None:
    camera = look_at((0, 0, 0), (0, 5, 0), focal=500, width=640, height=480)
    points = np.random.default_rng(0).uniform((-2, 4, -2), (2, 9, 2), (20, 3))
    fine, _ = project(resized(camera, 2), points)
    assert np.allclose(fine, 2 * project(camera, points)[0] + 0.5)
    assert (resized(camera, 0.25).width, resized(camera, 0.25).height) == (160, 120)


def test_cameras_at_one_point_have_no_fundamental_matrix() -> None:
    a = look_at((1, 2, 3), (4, 9, 3), focal=500, width=640, height=480)
    b = look_at((1, 2, 3), (5, 9, 3), focal=700, width=640, height=480)
    with pytest.raises(ValueError, match="one centre"):
        fundamental_of_cameras(a, b)


# Rendering


def test_a_wall_seen_head_on_is_the_picture_itself() -> None:
    """One texel a pixel, no rotation: any shift by half a pixel shows."""
    picture = smooth_texture()
    front = wall((-2.56, 10), (2.56, 10), -2.56, 2.56, mipmap(picture))
    camera = look_at((0, 0, 0), (0, 10, 0), focal=1000, width=256, height=200)
    image, depth = render([front], mipmap(picture), camera, sun=(0, 1, 0))  # lit from behind: ambient only
    expected = picture[156:356, 128:384].astype(np.float64)
    gain = (image * expected).sum() / (expected**2).sum()
    error = np.abs(image / gain - expected)
    assert np.median(error) < 1.5
    shifted = np.abs(image[:, 1:] / gain - (expected[:, 1:] + expected[:, :-1]) / 2)
    assert np.median(shifted) > 3 * np.median(error), "the test must be able to see half a pixel"
    assert np.allclose(depth, 10, atol=1e-4)


def test_the_nearest_surface_wins_whatever_the_order() -> None:
    sky = mipmap(np.zeros((16, 32, 3), dtype=np.uint8))
    white, grey = (mipmap(np.full((16, 16, 3), v, dtype=np.uint8)) for v in (255, 100))
    surfaces = [wall((-9, 8), (9, 8), -9, 9, grey), *box((0, 5), (1, 1, 1), (white,), white, base=-0.5)]
    camera = look_at((0, 0, 0), (0, 8, 0), focal=100, width=101, height=101)
    image, depth = render(surfaces, sky, camera)
    again, same_depth = render(surfaces[::-1], sky, camera)
    assert np.array_equal(image, again)
    assert np.array_equal(depth, same_depth)
    assert depth[50, 50] == pytest.approx(4.5)
    assert depth[10, 10] == pytest.approx(8)
    assert image[50, 50, 0] > 1.5 * image[10, 10, 0]


def test_a_surface_seen_edge_on_is_not_seen() -> None:
    texture = mipmap(smooth_texture())
    camera = look_at((0, 0, 1), (0, 5, 1), focal=100, width=60, height=40)
    _, depth = render([slab((-1, 3), (1, 6), 1.0, texture)], texture, camera)
    assert np.isinf(depth).all()


def test_the_floor_is_seen_up_to_the_horizon_and_the_sky_has_no_depth() -> None:
    texture = mipmap(smooth_texture())
    camera = look_at((0, 0, 1.5), (0, 10, 1.5), focal=100, width=120, height=101)
    _, depth = render([slab((-5e3, -5e3), (5e3, 5e3), 0, texture)], texture, camera)
    assert np.isinf(depth[:50]).all()
    assert np.isfinite(depth[52:]).all()
    assert depth[100, 60] == pytest.approx(1.5 * 100 / 50, rel=1e-5)


def test_a_far_texture_is_averaged() -> None:
    """A fine checkerboard a hundred times too fine for the image is grey, not moire."""
    checker = np.kron(np.indices((256, 256)).sum(axis=0) % 2, np.ones((2, 2))) * 255
    texture = mipmap(np.repeat(checker[..., None], 3, axis=2).astype(np.uint8))
    camera = look_at((0, 0, 0), (0, 50, 0), focal=100, width=64, height=64)
    surface = wall((-40, 50), (40, 50), -40, 40, texture, (20, 20))
    image, _ = render([surface], texture, camera)
    assert image.std() < 3


def test_sampling_a_level_does_not_read_its_neighbour() -> None:
    texture = mipmap(np.full((64, 48, 3), 200, dtype=np.uint8))
    edge = np.array([[0.0, 1.0], [1.0, 0.0]], dtype=np.float32)
    for footprint in (0.5, 2.0, 3.0, 100.0):
        assert (sample(texture, edge, edge.T, np.full((2, 2), footprint, np.float32)) == 200).all()


def test_a_view_warped_by_depth_falls_on_the_other() -> None:
    """Image, depth and camera agree to a small part of a pixel; half a pixel would show."""
    texture = mipmap(smooth_texture())
    surfaces = [
        wall((-6, 9), (2, 12), -3, 5, texture),
        wall((2, 12), (8, 7), -3, 5, texture),
        *box((0, 6), (1.5, 1.5, 3), (texture,), texture, yaw=30, base=-2),
    ]
    first = look_at((-1, 0, 1), (0, 10, 1), focal=420, width=400, height=300, roll=5)
    second = look_at((1.5, 1, 1.5), (0, 10, 1), focal=380, width=300, height=400, roll=-12)
    (image_a, depth_a), (image_b, depth_b) = (render(surfaces, texture, c) for c in (first, second))
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
    assert min(difference(shift) for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))) > 3 * difference((0, 0))


# Covisibility


def test_covisibility_of_two_halves_of_a_wall() -> None:
    texture = mipmap(smooth_texture())
    surfaces = [wall((-50, 10), (50, 10), -50, 50, texture)]
    # A view is 10 m wide at the wall; half of that is a baseline of 5 m.
    a, b = (look_at((x, 0, 0), (x, 10, 0), focal=200, width=200, height=150) for x in (0.0, 5.0))
    (_, depth_a), (_, depth_b) = (render(surfaces, texture, camera) for camera in (a, b))
    assert visible_share(a, depth_a, b, depth_b) == pytest.approx(0.5, abs=0.02)
    assert covisibility(a, depth_a, b, depth_b) == covisibility(b, depth_b, a, depth_a)
    assert covisibility(a, depth_a, a, depth_a) == 1


def test_what_is_hidden_or_sky_is_not_shared() -> None:
    texture = mipmap(smooth_texture())
    behind, screen = wall((-5, 10), (5, 10), -5, 5, texture), wall((3, 2), (7, 2), -5, 5, texture)
    a = look_at((0, 0, 0), (0, 10, 0), focal=200, width=200, height=150)
    b = look_at((5, 0, 0), (5, 10, 0), focal=200, width=200, height=150)
    _, depth_a = render([behind, screen], texture, a)
    _, depth_b = render([behind, screen], texture, b)
    assert (depth_b < 9).all(), "the screen fills the second view"
    assert covisibility(a, depth_a, b, depth_b) == 0
    sky = np.full((150, 200), np.inf, dtype=np.float32)
    assert covisibility(a, sky, b, sky) == 0


# The set on disk


def test_layout_of_the_train_side(demo: DemoSet) -> None:
    factors = {row["scene"]: float(row["scaling_factor"]) for row in rows(demo.train_dir / "scaling_factors.csv")}
    assert factors == {"courtyard": 2.5, "gallery": 1, "street": 1}
    for scene in SCENE_NAMES:
        ids = [row["image_id"] for row in rows(demo.train_dir / scene / "calibration.csv")]
        assert ids == sorted(path.stem for path in (demo.train_dir / scene / "images").glob("*.jpg"))
        assert 6 <= len(ids) <= 8
        assert not any("-" in name for name in ids)
        expected = {"-".join(sorted(two, reverse=True)) for two in combinations(ids, 2)}
        pairs = rows(demo.train_dir / scene / "pair_covisibility.csv")
        assert {row["pair"] for row in pairs} == expected
        assert len(pairs) == len(expected)


def test_overlap_is_partial_and_some_pairs_are_not_scored(demo: DemoSet) -> None:
    for scene in SCENE_NAMES:
        values = np.array(
            [float(r["covisibility"]) for r in rows(demo.train_dir / scene / "pair_covisibility.csv")]
        )
        assert ((values >= 0) & (values <= 1)).all()
        assert values.max() < 0.8
        scored = values >= 0.1
        assert 10 <= scored.sum() < len(values)
        assert ((values >= 0.1) & (values < 0.2)).sum() >= 3, "pairs for which cropping matters"


def test_images_differ_in_orientation_and_obey_image_scale(demo: DemoSet) -> None:
    for scene in SCENE_NAMES:
        sizes = {(camera.width, camera.height) for camera in cameras_of(demo, scene).values()}
        assert all(max(size) == round(800 * SCALE) for size in sizes)
        assert {width > height for width, height in sizes} == {True, False}


def test_image_scale_scales_the_intrinsics(scenes: dict[str, Scene], demo: DemoSet) -> None:
    written = cameras_of(demo, "gallery").values()
    halved = in_units(scenes["gallery"], 1.0, 0.5).views
    for view, camera, half in zip(scenes["gallery"].views, written, halved, strict=True):
        for name in ("K", "R", "t"):
            assert np.array_equal(getattr(camera, name), getattr(view.camera, name)), "every digit is there"
        assert half.camera.K[0, 0] == pytest.approx(camera.K[0, 0] / 2)
        assert half.camera.K[:2, 2] == pytest.approx((camera.K[:2, 2] + 0.5) / 2 - 0.5)


@pytest.mark.parametrize("scene_name", SCENE_NAMES)
def test_fundamental_matrices_fit_points_of_the_rendered_depth(
    demo: DemoSet, depths: dict[str, list[tuple[Camera, np.ndarray]]], scene_name: str
) -> None:
    cameras = cameras_of(demo, scene_name)
    depth_of = dict(zip(sorted(cameras), (depth for _, depth in depths[scene_name]), strict=True))
    for row in rows(demo.train_dir / scene_name / "pair_covisibility.csv"):
        F = numbers(row["fundamental_matrix"], 3, 3)
        assert np.linalg.norm(F) == pytest.approx(1)
        assert abs(np.linalg.det(F)) < 1e-12
        one, two = row["pair"].split("-")
        depth = depth_of[one]
        y, x = np.nonzero(np.isfinite(depth))
        first = np.column_stack([x, y])[::37].astype(float)
        points = unproject(cameras[one], first, depth[y, x][::37].astype(float))
        second, in_front = project(cameras[two], points)
        first, second = first[in_front > 0.1], second[in_front > 0.1]
        lines = np.column_stack([first, np.ones(len(first))]) @ F.T
        offsets = (lines * np.column_stack([second, np.ones(len(second))])).sum(axis=1)
        inside = (np.abs(second) < 4000).all(axis=1)
        assert inside.any()
        assert (np.abs(offsets) / np.hypot(lines[:, 0], lines[:, 1]))[inside].max() < 0.01
        # and not with the roles of the two images swapped
        swapped = first @ F[:2] + F[2]
        wrong = np.abs((swapped * np.column_stack([second, np.ones(len(second))])).sum(axis=1))
        assert np.median(wrong / np.hypot(swapped[:, 0], swapped[:, 1])) > 0.5


@pytest.mark.parametrize("scene_name", SCENE_NAMES)
def test_no_scored_pair_is_a_plane(depths: dict[str, list[tuple[Camera, np.ndarray]]], scene_name: str) -> None:
    """Else a homography would explain the pair and F would be anybody's guess."""
    for (first, depth_a), (second, depth_b) in combinations(depths[scene_name], 2):
        if covisibility(first, depth_a, second, depth_b) < 0.1:
            continue
        y, x = np.nonzero(visible_mask(first, depth_a, second, depth_b))
        here = np.column_stack([x, y])[::5].astype(float)
        there, _ = project(second, unproject(first, here, depth_a[y, x][::5].astype(float)))
        _, on_plane = cv2.findHomography(here, there, cv2.RANSAC, 0.75)
        assert on_plane.mean() < 0.9


def test_depth_of_a_scene_is_in_its_units(scenes: dict[str, Scene]) -> None:
    """2.5 m a unit: the camera 1.7 m above the ground is at 0.68."""
    scene = scenes["courtyard"]
    view = scene.views[0]
    assert view.camera.centre[2] * scene.metres_per_unit == pytest.approx(1.7, abs=0.15)
    _, depth = scene.render(View(view.camera, view.sun, ()))
    bottom = np.array([[view.camera.width / 2, view.camera.height - 1.0]])
    y, x = int(bottom[0, 1]), int(bottom[0, 0])
    (point,) = unproject(view.camera, bottom, np.array([float(depth[y, x])]))
    assert point[2] == pytest.approx(0, abs=1e-3)


def test_layout_of_the_test_side(demo: DemoSet) -> None:
    samples, truths = rows(demo.test_dir / "test.csv"), rows(demo.truth_csv)
    assert [row["sample_id"] for row in samples] == [row["sample_id"] for row in truths]
    assert len({row["sample_id"] for row in samples}) == len(samples)
    covisible = {
        (scene, frozenset(row["pair"].split("-"))): float(row["covisibility"])
        for scene in SCENE_NAMES
        for row in rows(demo.train_dir / scene / "pair_covisibility.csv")
    }
    used = set()
    for row, truth in zip(samples, truths, strict=True):
        batch, one, two = row["batch_id"], row["image_1_id"], row["image_2_id"]
        assert row["sample_id"] == f"{truth['scene']};{batch};{one}-{two}"
        assert len(batch) == 8
        assert len(one) == len(two) == 32
        assert set(batch + one + two) <= set("0123456789abcdef")
        assert one > two
        assert covisible[truth["scene"], frozenset((truth["image_1_id"], truth["image_2_id"]))] >= 0.1
        used |= {(batch, one), (batch, two)}
        for hidden, name in ((one, truth["image_1_id"]), (two, truth["image_2_id"])):
            png = cv2.imread(str(demo.test_dir / "test_images" / batch / f"{hidden}.png"))
            jpg = cv2.imread(str(demo.train_dir / truth["scene"] / "images" / f"{name}.jpg"))
            assert png.shape == jpg.shape
            assert np.abs(png.astype(int) - jpg).mean() < 6, "the same picture"
    on_disk = {(path.parent.name, path.stem) for path in (demo.test_dir / "test_images").rglob("*.png")}
    assert on_disk == used
    for scene in SCENE_NAMES:
        assert sum(truth["scene"] == scene for truth in truths) == 8


def test_same_seed_same_bytes_whatever_the_other_scenes(tmp_path: Path, demo: DemoSet) -> None:
    alone = write_demo(tmp_path, scenes=["gallery"], image_scale=SCALE)
    assert [path.name for path in alone.train_dir.iterdir() if path.is_dir()] == ["gallery"]
    assert bytes_of(alone.train_dir / "gallery") == bytes_of(demo.train_dir / "gallery")
    of_all = bytes_of(demo.test_dir / "test_images")
    assert bytes_of(alone.test_dir / "test_images").items() <= of_all.items()


def test_another_seed_is_another_set(tmp_path: Path, demo: DemoSet) -> None:
    other = write_demo(tmp_path, seed=1, scenes=["gallery"], image_scale=SCALE)
    one, two = (bytes_of(each.train_dir / "gallery") for each in (demo, other))
    assert one.keys() == two.keys()
    assert not set(one.values()) & set(two.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": ["castle"]}, "courtyard, gallery, street"),
        ({"scenes": ["street", "street"]}, "twice"),
        ({"image_scale": 0.0}, "positive"),
    ],
)
def test_bad_arguments_are_refused(tmp_path: Path, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_demo(tmp_path, **arguments)  # type: ignore[arg-type]


def test_importing_the_package_is_cheap() -> None:
    code = "import sys, mkpc_kaggle.demo; print('torch' in sys.modules, 'sklearn' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
