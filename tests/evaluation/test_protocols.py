import pickle
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pair_lists import line_of, line_of_pair, write_list
from protocol_by_hand import auc, evaluate
from rectified import RectifiedMatcher
from scipy.spatial.transform import Rotation
from shared import DATA, needs_data, run_command, scores_of, write_recipe

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.data.images import read_image
from mkpc_kaggle.data.pairs import read_pairs
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import pair_tables
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.evaluation.validate import by_protocol
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import pose_error
from mkpc_kaggle.geometry.robust import Method, ModelKind, RobustConfig, estimate
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.recipe import Recipe, Unit

K = np.array(
    [
        [800.0, 0, 320],
        [0, 800, 240],
        [0, 0, 1],
    ]
)
# Side by side, with a little forward motion, so that both epipoles are in no picture.
CAMERAS = (
    Camera(K, np.eye(3), np.zeros(3)),
    Camera(K, np.eye(3), np.array([1.0, 0, 0.1])),
)


def listed(file: Path, root: Path, recipe: Path) -> list[object]:
    return ["--pairs", file, "--image-root", root, "--recipe", recipe]


def matches_of(store: Store, position: int) -> Matches:
    published = Published.of(store)
    points = published.points_of(store, published.rows[position])
    return Matches.concatenate(points.values())


OUTDOORS = ["castle_p19", "fountain_p11", "herz_jesus_p8", "reichstag_26"]


def precise(camera: Camera) -> Camera:
    """The camera with a rotation of all digits: with six, the angle from a trace is wrong by up to
    0.1 degrees.
    """
    rotation = Rotation.from_matrix(camera.R)
    return replace(camera, R=rotation.as_matrix())


def evaluated_by_hand(work_dir: Path, lines, truths, side: int) -> list[dict[str, object]]:
    """The independent evaluation of a run's matches, whose poses must be those of the run."""
    expected = []
    with Store.read(work_dir) as store:
        _, units, _, estimates = pair_tables(store)
        for number, (line, true) in enumerate(zip(lines, truths, strict=True)):
            matches = matches_of(store, number)
            estimate = estimates.loc[number]
            keypoints = units["keypoints"][units["pair"] == estimate["pair"]].sum()
            # In double precision, as the other evaluation reads its lists.
            points = [each.astype(float) for each in (matches.points0, matches.points1)]
            sizes = [read_image(path).size for path in true.pair.images]
            by_hand = evaluate(line, points, keypoints, sizes, side)
            expected.append(by_hand)
            if by_hand["R"] is not None:
                own_R = Rotation.from_rotvec(estimate["rotation"]).as_matrix()
                np.testing.assert_allclose(own_R, by_hand["R"], atol=1e-6)
                # t is E's left null vector.
                residual = by_hand["t"] @ estimate["F"]
                np.testing.assert_allclose(residual, 0, atol=1e-6)
    return expected


@needs_data
@pytest.mark.parametrize(
    ("scenes", "pairs", "units"),
    # One unit as in SuperGlue's ScanNet evaluation, and several sizes with crops as in the paper.
    [
        (["scannet_samples"], 8, [(1, 640)]),
        (OUTDOORS, 1, [(1, 480), (1, 640), (2, 480)]),
    ],
)
def test_an_independent_evaluation_of_the_same_matches_agrees(scenes, pairs, units, tmp_path):
    train = DATA / "train"
    read = read_train_side(train, scenes=scenes, pairs_per_scene=pairs)
    truths = [true for scene in read for true in scene.pairs]
    lines = []
    for true in truths:
        camera0 = precise(true.camera0)
        camera1 = precise(true.camera1)
        sharp = replace(true, camera0=camera0, camera1=camera1)
        lines.append(line_of_pair(sharp, train))
    (tmp_path / "list.txt").write_text("\n".join(lines))
    recipe = write_recipe(tmp_path / "recipe.toml", *units)
    options = listed(tmp_path / "list.txt", train, recipe)
    scores = scores_of(
        tmp_path / "s.json", *options, "--protocol", "superglue", "--work-dir", tmp_path
    )
    # The threshold is a pixel of the largest picture of stage 1.
    side = max(side for stage, side in units if stage == 1)
    expected = evaluated_by_hand(tmp_path, lines, truths, side)
    (scene,) = scores["scenes"]
    own = {"rotation": "rotation_error_degrees", "translation": "translation_error_degrees"}
    for key in ("rotation", "translation", "precision", "matching_score"):
        values = [pair[own.get(key, key)] for pair in scene["pairs"]]
        # JSON has no infinity: an error of a failed pair is null.
        found = [np.inf if value is None else value for value in values]
        by_hand = [pair[key] for pair in expected]
        np.testing.assert_allclose(found, by_hand, atol=1e-6, err_msg=key)
        if key not in own:
            assert scores[key] == pytest.approx(np.mean(found), abs=1e-9)
    # A list has no metres, so a pair has no accuracy: 0 would be the worst one.
    assert scores["mAA"] is None
    assert all({*pair["accuracy_by_step"].values()} == {None} for pair in scene["pairs"])
    errors = [max(pair["rotation"], pair["translation"]) for pair in expected]
    for limit in (5, 10, 20):
        assert scores["AUC"][str(limit)] == pytest.approx(auc(errors, limit), abs=1e-6)
    assert any(np.isfinite(errors))


@pytest.mark.parametrize(("side", "width"), [(None, 1600), (1200, 1200), (0, 640)])
def test_the_threshold_that_reaches_opencv_is_a_pixel_of_the_resized_picture(
    side, width, monkeypatch, tmp_path
):
    """The stored images are 640 and 500 pixels wide, and resized to the same long side."""
    first, second = CAMERAS
    scale = 500 / 640
    small = Camera(np.diag([scale, scale, 1]) @ K, second.R, second.t)
    for name, shape in (("a.png", (480, 640)), ("b.png", (375, 500))):
        cv2.imwrite(str(tmp_path / name), np.full(shape, 90, np.uint8))
    line = line_of(("a.png", "b.png"), (first, small))
    (tmp_path / "list.txt").write_text(line)
    (true,) = read_pairs(tmp_path / "list.txt", tmp_path).pairs
    thresholds = []
    find = cv2.findEssentialMat

    def noted(*points, **settings):
        thresholds.append(settings["threshold"])
        return find(*points, **settings)

    monkeypatch.setattr(cv2, "findEssentialMat", noted)
    # The largest side of stage 1 counts; a crop of 2000 has pixels of another size.
    units = (
        Unit(1, "rectified", 1200),
        Unit(1, "rectified", 1600),
        Unit(2, "rectified", 2000),
    )
    recipe = by_protocol(Recipe(units), "superglue")
    if side is not None:
        magsac = replace(recipe.magsac, threshold_side=side)
        recipe = replace(recipe, magsac=magsac)
    matcher = TwoStageMatcher(recipe, matchers={"rectified": RectifiedMatcher()})
    matcher(*true.pair.images, model=ModelKind.E, intrinsics=true.pair.intrinsics)
    # A side of 0 means pixels of the stored pictures, whose focal lengths differ.
    focals = [800, scale * 800] if side == 0 else [800 * width / 640]
    assert thresholds == pytest.approx([1 / np.mean(focals)])


def test_five_matches_are_enough_for_an_essential_matrix_and_duplicates_count():
    generator = np.random.default_rng(1)
    points = generator.uniform((-1, -1, 3), (1, 1, 6), (5, 3))
    projected = []
    for camera in CAMERAS:
        x = (points + camera.t) @ K.T
        pixels = x[:, :2] / x[:, 2:]
        projected.append(pixels.astype(np.float32))
    five = Matches(*projected, np.ones(5))
    config = RobustConfig(Method.RANSAC, 1.0, permutations=1)
    # SuperGlue's evaluation passes all matches to OpenCV, which needs five.
    every = replace(config, every_match=True)
    alone = estimate(five, config, ModelKind.E, (K, K))
    assert alone.failure == "too few distinct matches for E: 5"
    found = estimate(five, every, ModelKind.E, (K, K))
    assert found.matrix.shape == (3, 3)
    assert found.inlier_count == 5
    # Eight matches, four of them distinct.
    twice = Matches.concatenate([five[:4], five[:4]])
    distinct = estimate(twice, config, ModelKind.E, (K, K))
    assert "too few distinct matches for E: 4" in distinct.failure
    of_all = estimate(twice, every, ModelKind.E, (K, K))
    assert "too few" not in of_all.failure


def test_points_in_front_of_both_cameras_decide_which_rotation_of_e_is_scored():
    """Matches of the twisted pair have the same E as the truth, whose rotation they do not have."""
    t = CAMERAS[1].t
    twisted = 2 * np.outer(t, t) / (t @ t) - np.eye(3)
    rng = np.random.default_rng(0)
    points = rng.uniform((6, -1, 1), (8, 1, 2), (40, 3))
    points[:, 0] *= points[:, 2]  # far to the side, in front of both
    pixels = []
    for in_camera in (points, points @ twisted.T + t):
        x = in_camera @ K.T
        assert x[:, 2].min() > 0
        pixels.append((x[:, :2] / x[:, 2:]).astype(np.float32))
    matches = Matches(*pixels, np.ones(40))
    recipe = by_protocol(Recipe((Unit(1, "sift", 640),)), "superglue")
    found = UnitResult(recipe.units[0], matches)
    size = Size(640, 480)
    pair = PairMatch((found,), sizes=(size, size))
    result = with_estimate(pair, recipe, ModelKind.E, (K, K)).estimate
    rotation = Rotation.from_rotvec(result.stats.rotation).as_matrix()
    calibrated = [camera.calibrated for camera in CAMERAS]
    # E alone allows both rotations, and the nearer to the truth would hide a wrong choice.
    assert pose_error(result.matrix, *calibrated, 1.0).rotation < 0.1
    assert pose_error(result.matrix, *calibrated, 1.0, rotation).rotation > 179


@pytest.fixture(scope="module")
def scenes(demo):
    return read_train_side(demo.train_dir, pairs_per_scene=3)


def write_scene_info(path: Path, scenes, root: Path) -> Path:
    """As numpy writes arrays of objects; images without a camera, and more than the two indices in
    a pair.
    """
    images = []
    for scene in scenes:
        for true in scene.pairs:
            images += zip(true.pair.images, (true.camera0, true.camera1), strict=True)
    # Arrays of objects, as MegaDepth's, with an entry of None for image 0
    poses = np.full(len(images) + 1, None, object)
    paths = poses.copy()
    Ks = poses.copy()
    infos = np.full(len(images) // 2, None, object)
    # Image 0 has no camera, as images without a depth map in MegaDepth.
    for number, (file, camera) in enumerate(images, 1):
        paths[number] = str(file.relative_to(root))
        Ks[number] = camera.K
        pose = np.column_stack([camera.R, camera.t])
        poses[number] = np.vstack([pose, [0, 0, 0, 1]])
    for number in range(len(infos)):
        pair = (2 * number + 1, 2 * number + 2)
        infos[number] = (pair, 0.5, np.zeros((1, 4)))
    np.savez(path, pair_infos=infos, image_paths=paths, intrinsics=Ks, poses=poses)
    return path


def test_megadepths_files_are_read_as_the_list_that_they_stand_for(demo, scenes, tmp_path):
    (tmp_path / "infos").mkdir()
    for number, scene in enumerate(scenes):
        write_scene_info(tmp_path / "infos" / f"{number}.npz", [scene], demo.train_dir)
    file = write_list(tmp_path / "list.txt", scenes, demo.train_dir)
    listed = read_pairs(file, demo.train_dir)
    found = read_pairs(tmp_path / "infos", demo.train_dir)
    for one, other in zip(found.pairs, listed.pairs, strict=True):
        assert one.pair == replace(other.pair, group="infos")
        cameras = [(one.camera0, other.camera0), (one.camera1, other.camera1)]
        for camera, truth in cameras:
            np.testing.assert_allclose(camera.K, truth.K)
            np.testing.assert_allclose(camera.R, truth.R, atol=1e-12)
            np.testing.assert_allclose(camera.t, truth.t, atol=1e-9)


class Run:
    """An object whose pickle calls a function when it is read."""

    def __reduce__(self):
        return print, ("executed",)


def pickled(data: bytes):
    """Write a scene_info whose arrays of objects are this pickle."""
    # An .npy header, padded to 128 bytes with its magic number and its length.
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n"
    array = b"\x93NUMPY\x01\x00\x76\x00" + header + data

    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for name in ("pair_infos", "image_paths", "intrinsics", "poses"):
                archive.writestr(f"{name}.npy", array)

    return write


def table(row: str, header: str = "image_0,image_1,box_0,box_1"):
    return text(f"{header}\n{row}\n")


def text(content: str):
    return lambda path: path.write_text(content)


def other_arrays(path: Path) -> None:
    np.savez(path, a=[1])


CODE = pickle.dumps(Run())
CUT_OFF = pickle.dumps([1, 2])[:-3]
BAD = {
    "other arrays": ("pairs.npz", other_arrays, "pair_infos.npy"),
    "code": ("pairs.npz", pickled(CODE), "it names builtins.print"),
    "cut off": ("pairs.npz", pickled(CUT_OFF), "is not a scene_info"),
    # Mistakes of users: another text, a folder without files.
    "no pairs": ("pairs.txt", text("a b\n"), "expected 38 fields"),
    "an empty directory": ("pairs", Path.mkdir, "cannot be read"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_lists_get_one_line_and_exit_2(name, demo, scenes, small_recipe, tmp_path, capsys):
    file, write, told = BAD[name]
    source = tmp_path / file
    write(source)
    command = ["validate", *listed(source, demo.train_dir, small_recipe)]
    assert run_command(*command) == 2
    out, err = capsys.readouterr()
    # NumPy's own reader would run the code of a pickle.
    assert "executed" not in out
    (line,) = err.splitlines()
    assert re.search(told, line)
