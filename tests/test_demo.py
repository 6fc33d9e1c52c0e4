"""The demo data set: its cameras, pixels and files agree with one another."""

import csv
import hashlib
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from mkpc_kaggle.demo import SCENE_NAMES, DemoSet, write_demo
from mkpc_kaggle.demo.camera import SizedCamera, look_at, project, resized, unproject
from mkpc_kaggle.demo.covisibility import covisibility, visible_mask
from mkpc_kaggle.demo.render import Surface, render, sample_texture
from mkpc_kaggle.demo.world import World, build_world, quad
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras

SCALE = 0.2


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory: pytest.TempPathFactory) -> DemoSet:
    return write_demo(tmp_path_factory.mktemp("demo"), image_scale=SCALE)


@pytest.fixture(scope="module")
def worlds() -> dict[str, World]:
    return {name: build_world(name, image_scale=SCALE) for name in SCENE_NAMES}


@pytest.fixture(scope="module")
def depths(worlds: dict[str, World]) -> dict[str, list[tuple[SizedCamera, np.ndarray]]]:
    """Of each scene the cameras and the depth maps, rendered anew."""
    return {
        name: [(camera, render(world.surfaces, camera)[1]) for camera in world.cameras]
        for name, world in worlds.items()
    }


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(text: str, *shape: int) -> np.ndarray:
    return np.array([float(word) for word in text.split(" ")]).reshape(shape)


def cameras_of(demo: DemoSet, scene: str) -> dict[str, SizedCamera]:
    cameras = {}
    for row in rows(demo.train_dir / scene / "calibration.csv"):
        picture = cv2.imread(str(demo.train_dir / scene / "images" / f"{row['image_id']}.jpg"))
        cameras[row["image_id"]] = SizedCamera(
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


def smooth_texture() -> np.ndarray:
    """Blobs of some 16 texels: the intensity changes fast enough to show half a pixel."""
    noise = np.random.default_rng(0).uniform(0, 255, (32, 32, 3)).astype(np.uint8)
    return cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)


def upright(left: tuple[float, float], right: tuple[float, float], low: float, high: float, texture: np.ndarray):
    return quad((*left, high), (*right, high), (*left, low), texture)


# Cameras


def test_look_at_puts_the_target_in_the_middle_and_world_up_upwards() -> None:
    camera = look_at((1, 2, 1.5), (4, 9, 3), 500, (640, 480))
    pixels, depth = project(camera, np.array([[4, 9, 3], [4, 9, 3.5]], dtype=float))
    assert np.allclose(pixels[0], (319.5, 239.5))
    assert pixels[1, 0] == pytest.approx(319.5)
    assert pixels[1, 1] < 239.5
    assert (depth > 0).all()
    assert np.allclose(camera.R @ camera.R.T, np.eye(3))
    assert np.linalg.det(camera.R) == pytest.approx(1)
    assert np.allclose(camera.centre, (1, 2, 1.5))


def test_roll_turns_the_camera_clockwise() -> None:
    rolled = look_at((0, 0, 0), (0, 5, 0), 500, (640, 480), roll=90)
    pixels, _ = project(rolled, np.array([[1.0, 5, 0]]))
    assert np.allclose(pixels[0], (319.5, 239.5 - 100)), "what was on the right is now above"


def test_unproject_is_the_inverse_of_project() -> None:
    camera = look_at((1, 2, 1.5), (4, 9, 3), 500, (640, 480), roll=20)
    points = np.random.default_rng(0).uniform((-5, 8, -2), (9, 20, 6), (50, 3))
    assert np.allclose(unproject(camera, *project(camera, points)), points)


def test_a_resized_camera_keeps_pixel_centres_where_they_are() -> None:
    camera = look_at((0, 0, 0), (0, 5, 0), 500, (640, 480))
    points = np.random.default_rng(0).uniform((-2, 4, -2), (2, 9, 2), (20, 3))
    fine, _ = project(resized(camera, 2), points)
    assert np.allclose(fine, 2 * project(camera, points)[0] + 0.5)
    assert (resized(camera, 0.25).width, resized(camera, 0.25).height) == (160, 120)


def test_cameras_at_one_point_have_no_fundamental_matrix() -> None:
    a = look_at((1, 2, 3), (4, 9, 3), 500, (640, 480))
    b = look_at((1, 2, 3), (5, 9, 3), 700, (640, 480))
    with pytest.raises(ValueError, match="one centre"):
        fundamental_of_cameras(a, b)


# Rendering


def test_a_wall_seen_head_on_is_the_picture_itself() -> None:
    """One texel a pixel, no rotation: any shift by half a pixel shows."""
    picture = smooth_texture()
    # Seen from the north, where the sun does not shine.
    camera = look_at((0, 0, 0), (0, -10, 0), 1000, (256, 200))
    image, depth = render([upright((2.56, -10), (-2.56, -10), -2.56, 2.56, picture)], camera)
    expected = picture[156:356, 128:384].astype(np.float64)
    gain = (image * expected).sum() / (expected**2).sum()
    error = np.abs(image / gain - expected)
    assert np.median(error) < 1.5
    shifted = np.abs(image[:, 1:] / gain - (expected[:, 1:] + expected[:, :-1]) / 2)
    assert np.median(shifted) > 3 * np.median(error), "the test must be able to see half a pixel"
    assert np.allclose(depth, 10, atol=1e-4)


def test_the_nearest_surface_wins_whatever_the_order() -> None:
    white, grey = (np.full((16, 16, 3), value, dtype=np.uint8) for value in (255, 100))
    surfaces = [upright((-9, 8), (9, 8), -9, 9, grey), upright((-0.5, 4.5), (0.5, 4.5), -0.5, 0.5, white)]
    camera = look_at((0, 0, 0), (0, 8, 0), 100, (101, 101))
    image, depth = render(surfaces, camera)
    again, same_depth = render(surfaces[::-1], camera)
    assert np.array_equal(image, again)
    assert np.array_equal(depth, same_depth)
    assert depth[50, 50] == pytest.approx(4.5)
    assert depth[10, 10] == pytest.approx(8)
    assert image[50, 50, 0] > 1.5 * image[10, 10, 0]


def floor(low: tuple[float, float], high: tuple[float, float], z: float) -> Surface:
    return quad((low[0], high[1], z), (*high, z), (*low, z), smooth_texture())


def test_a_surface_seen_edge_on_is_not_seen() -> None:
    _, depth = render([floor((-1, 3), (1, 6), 1.0)], look_at((0, 0, 1), (0, 5, 1), 100, (60, 40)))
    assert np.isinf(depth).all()


def test_the_floor_is_seen_up_to_the_horizon_and_the_sky_has_no_depth() -> None:
    camera = look_at((0, 0, 1.5), (0, 10, 1.5), 100, (120, 101))
    _, depth = render([floor((-5e3, -5e3), (5e3, 5e3), 0)], camera)
    assert np.isinf(depth[:50]).all()
    assert np.isfinite(depth[52:]).all()
    assert depth[100, 60] == pytest.approx(1.5 * 100 / 50, rel=1e-5)


def test_a_far_texture_is_averaged() -> None:
    """A fine checkerboard a hundred times too fine for the image is grey, not moire."""
    checker = np.kron(np.indices((1024, 1024)).sum(axis=0) % 2, np.ones((2, 2))) * 255
    texture = np.repeat(checker[..., None], 3, axis=2).astype(np.uint8)
    image, _ = render(
        [upright((-40, 50), (40, 50), -40, 40, texture)], look_at((0, 0, 0), (0, 50, 0), 10, (16, 16))
    )
    assert image.std() < 3


def test_a_texture_is_not_read_beyond_its_edge() -> None:
    levels = Surface(*np.zeros((3, 3)), np.full((64, 48, 3), 200, dtype=np.uint8)).levels
    assert [level.shape[:2] for level in levels] == [(64, 48), (32, 24), (16, 12)]
    edge = np.array([[0.0, 1.0], [1.0, 0.0]], dtype=np.float32)
    for footprint in (0.5, 2.0, 3.0, 100.0):
        found = sample_texture(levels, edge, edge.T, np.full((2, 2), footprint, np.float32))
        assert np.allclose(found, 200, atol=1e-3)


def test_a_view_warped_by_depth_falls_on_the_other() -> None:
    """Image, depth and camera agree to a small part of a pixel; half a pixel would show."""
    texture = smooth_texture()
    surfaces = [
        upright((-6, 9), (2, 12), -3, 5, texture),
        upright((2, 12), (8, 7), -3, 5, texture),
        upright((-0.5, 6), (1, 5.5), -2, 1, texture),
    ]
    first = look_at((-1, 0, 1), (0, 10, 1), 420, (400, 300), roll=5)
    second = look_at((1.5, 1, 1.5), (0, 10, 1), 380, (300, 400), roll=-12)
    (image_a, depth_a), (image_b, depth_b) = (render(surfaces, camera) for camera in (first, second))
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
    surfaces = [upright((-50, 10), (50, 10), -50, 50, smooth_texture())]
    # A view is 10 m wide at the wall; half of that is a baseline of 5 m.
    a, b = (look_at((x, 0, 0), (x, 10, 0), 200, (200, 150)) for x in (0.0, 5.0))
    (_, depth_a), (_, depth_b) = (render(surfaces, camera) for camera in (a, b))
    assert covisibility(a, depth_a, b, depth_b) == pytest.approx(0.5, abs=0.02)
    assert covisibility(a, depth_a, b, depth_b) == covisibility(b, depth_b, a, depth_a)
    assert covisibility(a, depth_a, a, depth_a) == 1


def test_what_is_hidden_or_sky_is_not_shared() -> None:
    texture = smooth_texture()
    surfaces = [upright((-5, 10), (5, 10), -5, 5, texture), upright((3, 2), (7, 2), -5, 5, texture)]
    a, b = (look_at((x, 0, 0), (x, 10, 0), 200, (200, 150)) for x in (0.0, 5.0))
    (_, depth_a), (_, depth_b) = (render(surfaces, camera) for camera in (a, b))
    assert (depth_b < 9).all(), "the screen fills the second view"
    assert covisibility(a, depth_a, b, depth_b) == 0
    sky = np.full((150, 200), np.inf, dtype=np.float32)
    assert covisibility(a, sky, b, sky) == 0


# The set on disk


def test_layout_of_the_train_side(small_demo: DemoSet) -> None:
    factors = {
        row["scene"]: float(row["scaling_factor"]) for row in rows(small_demo.train_dir / "scaling_factors.csv")
    }
    assert factors == {"courtyard": 2.5, "market": 1}
    for scene in SCENE_NAMES:
        ids = [row["image_id"] for row in rows(small_demo.train_dir / scene / "calibration.csv")]
        assert ids == sorted(path.stem for path in (small_demo.train_dir / scene / "images").glob("*.jpg"))
        assert len(ids) == 7
        assert not any("-" in name for name in ids)
        expected = {"-".join(sorted(two, reverse=True)) for two in combinations(ids, 2)}
        pairs = rows(small_demo.train_dir / scene / "pair_covisibility.csv")
        assert {row["pair"] for row in pairs} == expected
        assert len(pairs) == len(expected)


def test_overlap_is_partial_and_some_pairs_are_not_scored(small_demo: DemoSet) -> None:
    for scene in SCENE_NAMES:
        pairs = rows(small_demo.train_dir / scene / "pair_covisibility.csv")
        values = np.array([float(row["covisibility"]) for row in pairs])
        assert ((values >= 0) & (values <= 1)).all()
        assert values.max() < 0.8
        assert 10 <= (values >= 0.1).sum() < len(values)
        assert ((values >= 0.1) & (values < 0.2)).sum() >= 3, "pairs for which cropping matters"


def test_images_differ_in_orientation_and_obey_image_scale(small_demo: DemoSet) -> None:
    for scene in SCENE_NAMES:
        sizes = {(camera.width, camera.height) for camera in cameras_of(small_demo, scene).values()}
        assert all(max(size) == round(800 * SCALE) for size in sizes)
        assert {width > height for width, height in sizes} == {True, False}


def test_image_scale_scales_the_intrinsics(worlds: dict[str, World], small_demo: DemoSet) -> None:
    written = cameras_of(small_demo, "market").values()
    for camera, here, whole in zip(worlds["market"].cameras, written, build_world("market").cameras, strict=True):
        for name in ("K", "R", "t"):
            assert np.array_equal(getattr(here, name), getattr(camera, name)), "every digit is there"
        assert whole.K[0, 0] * SCALE == pytest.approx(here.K[0, 0])
        assert here.K[:2, 2] == pytest.approx((whole.K[:2, 2] + 0.5) * SCALE - 0.5)


@pytest.mark.parametrize("scene_name", SCENE_NAMES)
def test_fundamental_matrices_fit_points_of_the_rendered_depth(
    small_demo: DemoSet, depths: dict[str, list[tuple[SizedCamera, np.ndarray]]], scene_name: str
) -> None:
    cameras = cameras_of(small_demo, scene_name)
    depth_of = dict(zip(sorted(cameras), (depth for _, depth in depths[scene_name]), strict=True))
    for row in rows(small_demo.train_dir / scene_name / "pair_covisibility.csv"):
        F = numbers(row["fundamental_matrix"], 3, 3)
        assert np.linalg.norm(F) == pytest.approx(1)
        assert abs(np.linalg.det(F)) < 1e-12
        name0, name1 = row["pair"].split("-")
        depth = depth_of[name0]
        y, x = np.nonzero(np.isfinite(depth))
        first = np.column_stack([x, y])[::37].astype(float)
        points = unproject(cameras[name0], first, depth[y, x][::37].astype(float))
        second, in_front = project(cameras[name1], points)
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
def test_no_scored_pair_is_a_plane(
    depths: dict[str, list[tuple[SizedCamera, np.ndarray]]], scene_name: str
) -> None:
    """Else a homography would explain the pair and F would be anybody's guess."""
    for (first, depth_a), (second, depth_b) in combinations(depths[scene_name], 2):
        if covisibility(first, depth_a, second, depth_b) < 0.1:
            continue
        y, x = np.nonzero(visible_mask(first, depth_a, second, depth_b))
        here = np.column_stack([x, y])[::5].astype(float)
        there, _ = project(second, unproject(first, here, depth_a[y, x][::5].astype(float)))
        _, on_plane = cv2.findHomography(here, there, cv2.RANSAC, 0.75)
        assert on_plane.mean() < 0.98


def test_depth_of_a_scene_is_in_its_units(worlds: dict[str, World]) -> None:
    """2.5 m a unit: the camera 1.7 m above the ground is at 0.68."""
    world = worlds["courtyard"]
    camera = world.cameras[0]
    assert camera.centre[2] * world.metres_per_unit == pytest.approx(1.7, abs=0.15)
    _, depth = render(world.surfaces, camera)
    bottom = np.array([[camera.width // 2, camera.height - 1.0]])
    (point,) = unproject(camera, bottom, depth[-1:, camera.width // 2].astype(float))
    assert point[2] == pytest.approx(0, abs=1e-3)


def test_layout_of_the_test_side(small_demo: DemoSet) -> None:
    samples, truths = rows(small_demo.test_dir / "test.csv"), rows(small_demo.truth_csv)
    assert [row["sample_id"] for row in samples] == [row["sample_id"] for row in truths]
    assert len({row["sample_id"] for row in samples}) == len(samples)
    covisible = {
        (scene, frozenset(row["pair"].split("-"))): float(row["covisibility"])
        for scene in SCENE_NAMES
        for row in rows(small_demo.train_dir / scene / "pair_covisibility.csv")
    }
    used = set()
    for row, truth in zip(samples, truths, strict=True):
        batch, id0, id1 = row["batch_id"], row["image_1_id"], row["image_2_id"]
        assert row["sample_id"] == f"{truth['scene']};{batch};{id0}-{id1}"
        assert len(batch) == 8
        assert len(id0) == len(id1) == 32
        assert set(batch + id0 + id1) <= set("0123456789abcdef")
        assert id0 > id1
        assert covisible[truth["scene"], frozenset((truth["image_1_id"], truth["image_2_id"]))] >= 0.1
        used |= {(batch, id0), (batch, id1)}
        for hidden, name in ((id0, truth["image_1_id"]), (id1, truth["image_2_id"])):
            png = cv2.imread(str(small_demo.test_dir / "test_images" / batch / f"{hidden}.png"))
            jpg = cv2.imread(str(small_demo.train_dir / truth["scene"] / "images" / f"{name}.jpg"))
            assert png.shape == jpg.shape
            assert np.abs(png.astype(int) - jpg).mean() < 6, "the same picture"
    on_disk = {(path.parent.name, path.stem) for path in (small_demo.test_dir / "test_images").rglob("*.png")}
    assert on_disk == used
    for scene in SCENE_NAMES:
        assert sum(truth["scene"] == scene for truth in truths) == 8


def test_same_seed_same_bytes_whatever_the_other_scenes(tmp_path: Path, small_demo: DemoSet) -> None:
    alone = write_demo(tmp_path, scenes=["market"], image_scale=SCALE)
    assert [path.name for path in alone.train_dir.iterdir() if path.is_dir()] == ["market"]
    assert bytes_of(alone.train_dir / "market") == bytes_of(small_demo.train_dir / "market")
    of_all = bytes_of(small_demo.test_dir / "test_images")
    assert bytes_of(alone.test_dir / "test_images").items() <= of_all.items()


def test_another_seed_is_another_set(tmp_path: Path, small_demo: DemoSet) -> None:
    other = write_demo(tmp_path, seed=1, scenes=["market"], image_scale=SCALE)
    here, there = (bytes_of(demo.train_dir / "market") for demo in (small_demo, other))
    assert here.keys() == there.keys()
    assert not set(here.values()) & set(there.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": ["castle"]}, "courtyard, market"),
        ({"scenes": ["market", "market"]}, "twice"),
        ({"image_scale": 0.0}, "positive"),
    ],
)
def test_bad_arguments_are_refused(tmp_path: Path, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_demo(tmp_path, **arguments)  # type: ignore[arg-type]
