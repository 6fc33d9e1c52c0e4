"""Lists of pairs: lines that are read or refused, and scores of a list."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pair_lists import line_of, turned_camera, write_list
from shared import scores_of

from mkpc_kaggle.data.competition import Pair, read_train_side
from mkpc_kaggle.data.pairs import parse_line, read_pairs
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.recipe import load_recipe

WHERE = Path("list.txt"), 7, Path("images")
EYE = " ".join(["1 0 0 0 1 0 0 0 1"] * 2 + ["1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1"])
K = np.array(
    [
        [500.0, 0, 31.5],
        [0, 450, 20.25],
        [0, 0, 1],
    ]
)
R = cv2.Rodrigues(np.array([0.1, -0.3, 0.2]))[0]
CAMERA = Camera(K, R, np.array([0.2, -0.1, 0.5]))


def test_a_line_gives_the_images_turns_and_cameras_that_were_written():
    first = Camera(K, R, np.array([1.0, 2, 3]))
    true = parse_line(line_of(("a/b.jpg", "c.png"), (first, CAMERA), (3, 1)), *WHERE)
    assert true.pair.images == (Path("images/a/b.jpg"), Path("images/c.png"))
    assert true.pair.turns == (3, 1)
    assert true.pair.id == "7: a/b.jpg turned 3 c.png turned 1"
    np.testing.assert_array_equal(true.camera0.K, K)
    # A list has the relative pose alone, so only F can be compared.
    found = fundamental_of_cameras(true.camera0, true.camera1)
    np.testing.assert_allclose(found, fundamental_of_cameras(first, CAMERA), atol=1e-15)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("a b", "expected 38 fields, name0 name1 .* found 2"),
        # SuperGlue's lists count quarter turns of EXIF.
        (f"a b 0 4 {EYE}", "expected 0, 1, 2 or 3 quarter turns, found 0 and 4"),
        (f"a b 0 0 {EYE}".replace("1 0 0 0 1", "1 0 x 0 1", 1), "expected numbers .*'x'"),
        (
            f"a b 0 0 {EYE}".replace("1 0 0 0 1", "1 0 nan 0 1", 1),
            "expected finite numbers for K0, K1 and T_0to1",
        ),
        (f"a b 0 0 {EYE}".replace("1 0 0 0 1", "-1 0 0 0 1", 1), "expected K0 and K1 = fx s cx"),
        (f"a b 0 0 {EYE}".replace("0 0 0 1", "0 0 0 2").strip(), "expected T_0to1 = .*|expected K"),
        (f"a b 0 0 {EYE}".replace("1 0 0 1 0 1 0 0", "-1 0 0 1 0 1 0 0"), "with R a rotation"),
    ],
)
def test_a_malformed_line_is_named_with_what_was_expected(line, expected):
    with pytest.raises(UserError, match=rf"^list.txt, line 7: .*({expected})"):
        parse_line(line, *WHERE)


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../a.jpg",
        "a/../../b.jpg",
        "..",
        "//host/a",
        "..\\a",
        "a\\..\\b",
        "\\a",
        "C:\\a",
    ],
)
def test_no_name_leads_out_of_the_image_root(name):
    # Lists are downloaded files, and a report shows the images that they name.
    for names in (f"{name} ok.jpg", f"ok.jpg {name}"):
        with pytest.raises(UserError, match=r"list.txt, line 7: .* points outside the image root"):
            parse_line(f"{names} 0 0 {EYE}", *WHERE)
    pair = parse_line(f"a/b..c.jpg ./d.jpg 0 0 {EYE}", *WHERE).pair
    assert pair.images == (Path("images/a/b..c.jpg"), Path("images/d.jpg"))


def test_a_list_without_pairs_is_refused(tmp_path):
    path = tmp_path / "list.txt"
    for root, told in (
        (".", r"list.txt cannot be read: No such file"),
        ("x", r"--image-root .*: no such directory"),
    ):
        with pytest.raises(UserError, match=told):
            read_pairs(path, tmp_path / root)
    for content, told in ((b"\n \n", "has no pairs"), (b"\xff\xfe", "not UTF-8")):
        path.write_bytes(content)
        with pytest.raises(UserError, match=told):
            read_pairs(path, tmp_path)


@pytest.fixture
def scenes(demo):
    return read_train_side(demo.train_dir, pairs_per_scene=3)


def test_the_true_matrix_has_no_error(demo, scenes, tmp_path):
    read = read_pairs(write_list(tmp_path / "list.txt", scenes, demo.train_dir), demo.train_dir)
    some = read_pairs(tmp_path / "list.txt", demo.train_dir, most=2)
    assert [true.pair.id for true in some.pairs] == [read.pairs[0].pair.id, read.pairs[2].pair.id]
    for true in read.pairs:
        assert true.pair.intrinsics is not None
        cameras = true.camera0.calibrated, true.camera1.calibrated
        # Near a cosine of 1 the angle of a rounding error is a millionth of a degree.
        assert error_of(fundamental_of_cameras(*cameras), true, read).angle < 1e-5
        assert all(path.is_file() for path in true.pair.images)


def test_a_listed_image_is_set_upright_and_scored_as_it_is_stored(
    demo, scenes, small_recipe, tmp_path
):
    """Images stored on their sides, with cameras to match, score as the upright images do; a
    missing one fails.
    """
    true = max(scenes[0].pairs, key=lambda true: true.covisibility)
    sides = list(zip(true.pair.images, (true.camera0, true.camera1), strict=True))
    lines = []
    for number, turns in enumerate([(1, 3), (2, 0), (3, 3)]):
        names = []
        cameras = []
        for quarters, (path, camera) in zip(turns, sides, strict=True):
            names.append(f"{number}-{path.stem}.png")
            upright = cv2.imread(str(path))
            cv2.imwrite(str(tmp_path / names[-1]), np.rot90(upright, -quarters))
            cameras.append(turned_camera(camera, -quarters, Size(*upright.shape[1::-1])))
        lines.append(line_of((names[0], names[1]), (cameras[0], cameras[1]), turns))
    lines.append(line_of(("missing.jpg", "none.jpg"), (true.camera0, true.camera1)))
    (tmp_path / "list.txt").write_text("\n\n".join(lines))
    options = ["--pairs", tmp_path / "list.txt", "--image-root", tmp_path]
    options += ["--recipe", small_recipe]
    options += ["--set", "magsac.method=ransac", "--set", "magsac.threshold=1"]
    scores = scores_of(tmp_path / "scores.json", *options)
    *found, missing = scores["scenes"][0]["pairs"]
    # A turn that was forgotten is an error of 90 degrees.
    assert max(pair["rotation_error_degrees"] for pair in found) < 5
    assert (missing["rotation_error_degrees"], scores["mAA"]) == (None, None)
    assert missing["pair"] == "7: missing.jpg none.jpg", "by its line"
    assert "no such file" in missing["failure"]
    assert 0 < scores["AUC"]["20"] < 0.75, "of four pairs one has failed"


def test_the_estimate_of_a_pair_depends_on_its_cameras():
    keys = Keys(())
    pair = Pair("p", "b", "0", "1")
    digests = []
    # A corrected list of cameras must not use the estimates of the former one.
    for both in (None, (K, K), (K, K + 1)):
        digests.append(keys.of_estimate(replace(pair, intrinsics=both), ["points"]))
    assert len(set(digests)) == 3


def test_units_are_taken_in_the_order_in_which_they_are_named():
    recipe = load_recipe("yfcc").with_units(["1:superglue@1600", "2:superglue@1400"])
    assert [unit.name for unit in recipe.units] == ["1:superglue@1600", "2:superglue@1400"]
