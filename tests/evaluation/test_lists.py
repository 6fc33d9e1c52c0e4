"""Lists of pairs: lines that are read or refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pair_lists import line_of

from benchmarks.lists import parse_line
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras

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
        (f"a b 0 4 {EYE}", "0, 1, 2 or 3 quarter turns"),
        (
            f"a b 0 0 {EYE}".replace("1 0 0 0 1", "1 0 nan 0 1", 1),
            "expected finite numbers",
        ),
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
        "..\\a",
        "C:\\a",
    ],
)
def test_no_name_leads_out_of_the_image_root(name):
    # Lists are downloaded files, and a report shows the images that they name.
    for names in (f"{name} ok.jpg", f"ok.jpg {name}"):
        with pytest.raises(
            UserError, match=r"list.txt, line 7: .* points outside the image root"
        ):
            parse_line(f"{names} 0 0 {EYE}", *WHERE)
    pair = parse_line(f"a/b..c.jpg ./d.jpg 0 0 {EYE}", *WHERE).pair
    assert pair.images == (Path("images/a/b..c.jpg"), Path("images/d.jpg"))
