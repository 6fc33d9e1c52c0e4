"""Files of the competition: reading, refusals with their words, writing."""

import os
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mkpc_kaggle.data import competition
from mkpc_kaggle.data.competition import (
    missing_line,
    read_rows,
    read_submission,
    read_test_side,
    read_train_side,
    write_submission,
)
from mkpc_kaggle.errors import UserError

HEADER = "sample_id,batch_id,image_1_id,image_2_id"
EYE = np.eye(3)


@pytest.fixture
def side(tmp_path):
    """A function that writes test.csv and empty image files; it returns the directory."""

    def write(*rows, header=HEADER, images=()):
        (tmp_path / "test_images").mkdir(exist_ok=True)
        for name in images:
            path = tmp_path / "test_images" / name
            path.parent.mkdir(exist_ok=True)
            path.touch()
        (tmp_path / "test.csv").write_text(
            "\n".join([header, *rows]) + "\n", encoding="utf-8"
        )
        return tmp_path

    return write


@pytest.fixture
def train(tmp_path):
    """A train side by hand: scene ``s`` with images a, b, c, d and six pairs."""
    (tmp_path / "s" / "images").mkdir(parents=True)
    (tmp_path / "s" / "images" / "a.JPG").touch()
    lines = ["image_id,camera_intrinsics,rotation_matrix,translation_vector"]
    for x, name in enumerate("abcd"):
        lines.append(f"{name},2 0 1 0 2 1 0 0 1,1 0 0 0 1 0 0 0 1,{x} 0 0")
    (tmp_path / "s" / "calibration.csv").write_text("\n".join(lines) + "\n")
    pairs = ["b-a,0.9", "c-a,0.1", "c-b,0.5", "d-a,0.09", "d-b,0.3", "d-c,0.7"]
    lines = ["pair,covisibility", *pairs]
    (tmp_path / "s" / "pair_covisibility.csv").write_text("\n".join(lines) + "\n")
    # The competition's file lists scenes that a user may not have downloaded.
    (tmp_path / "scaling_factors.csv").write_text("scene,scaling_factor\ns,2.5\nabsent,1\n")
    return tmp_path


def keys(scene):
    return [true.pair.id.partition(";")[2] for true in scene.pairs]


def test_pairs_and_columns_come_in_any_order_and_ids_are_text(side):
    # Ids that pandas and spreadsheets read as numbers or as missing values.
    rows = ["0010,more,1e3,NA,007", "2,x,b,1,a", "1,x,b,2,z"]
    images = ["1e3/NA.png", "1e3/0010.Jpg", "1e3/00.png", "1e3/0010.txt"]
    home = side(*rows, header="image_2_id,more,batch_id,image_1_id,sample_id", images=images)
    pairs = read_test_side(home)
    assert [(pair.id, pair.group) for pair in pairs] == [
        ("007", "1e3"),
        ("a", "b"),
        ("z", "b"),
    ]
    assert [image.name for image in pairs[0].images] == ["NA.png", "0010.Jpg"]
    # A missing image costs its pairs, not the run.
    assert not pairs[1].images[0].is_file()
    # Users name the folder of images as often as the folder above it.
    assert read_test_side(home / "test_images") == pairs


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "missing columns"),
        (HEADER.encode() + b"\n", "has no rows"),
        (b"\x89PNG\r\n\x1a\n\xff\xfe\x00", "cannot be read as a table"),
        (HEADER.encode() + b"\ns,b,1,2\n\nt,b,1,2,3,4\n", "line 4: the header has 4 cells"),
        (
            HEADER.encode() + b"\ns,b,1,2\nt,b,1,3\ns,b,2,3\n",
            "line 4: the sample_id 's' is not unique",
        ),
        (HEADER.encode() + "\na\u2028b,b,1,2\n".encode(), "has control characters"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_by_name(side, content, says):
    home = side()
    (home / "test.csv").write_bytes(content)
    with pytest.raises(UserError, match=f"{re.escape(str(home / 'test.csv'))}.*{says}"):
        read_test_side(home)


def test_a_directory_without_its_table_or_images_is_refused(side):
    home = side("s,b,1,2")
    (home / "test_images").rmdir()
    with pytest.raises(UserError, match=r"test_images: no such directory"):
        read_test_side(home)
    (home / "test.csv").unlink()
    with pytest.raises(UserError, match=r"test\.csv: no such file"):
        read_test_side(home)
    os.mkfifo(home / "test.csv")  # opening a pipe waits for a writer that never comes
    with pytest.raises(UserError, match="not a regular file"):
        read_test_side(home)


# Ids become paths of images, and of files that a report writes.
@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "/etc", "x\\y", "C:x", "a\x1bb", "a\x7f"]
)
def test_an_id_that_is_not_a_plain_name_is_refused(side, name):
    for row in ("s,{},1,2", "s,b,{},2", "s,b,1,{}"):
        home = side("ok,b,1,2", row.format(name))
        with pytest.raises(UserError, match=r"test\.csv.* is not a plain name"):
            read_test_side(home)


def test_a_train_side_is_read_with_its_cameras_and_its_scale(train):
    (scene,) = read_train_side(train)
    assert (scene.name, scene.metres_per_unit) == ("s", 2.5)
    first = scene.pairs[0]
    assert (first.pair.id, first.pair.group, first.covisibility) == ("s;b-a", "s", 0.9)
    assert [image.name for image in first.pair.images] == ["b.png", "a.JPG"]
    assert_array_equal(first.camera0.K, [[2, 0, 1], [0, 2, 1], [0, 0, 1]])
    assert_array_equal([first.camera0.t, first.camera1.t], [[1, 0, 0], [0, 0, 0]])


def test_pairs_below_the_covisibility_are_left_out_and_others_are_spread_over_the_table(
    train,
):
    assert keys(*read_train_side(train)) == ["b-a", "c-a", "c-b", "d-b", "d-c"]
    assert keys(*read_train_side(train, min_covisibility=0.5)) == ["b-a", "c-b", "d-c"]
    assert len(keys(*read_train_side(train, min_covisibility=0))) == 6
    # Evenly spread: the first rows of a table share an image.
    chosen = [keys(*read_train_side(train, pairs_per_scene=most)) for most in (1, 2, 3)]
    assert chosen == [["b-a"], ["b-a", "d-c"], ["b-a", "c-b", "d-c"]]


TRAIN_REFUSALS = [  # file, text, its replacement, options, message
    (
        "s/calibration.csv",
        "",
        "",
        {"scenes": ["s", "x"]},
        "unknown scene 'x'; known: absent, s",
    ),
    ("s/calibration.csv", "", "", {"scenes": ["absent"]}, "calibration.csv: no such file"),
    (
        "s/calibration.csv",
        "",
        "",
        {"min_covisibility": 1.1},
        "covisibility.csv has no pair with",
    ),
    (
        "s/calibration.csv",
        "2 0 1 0 2 1 0 0 1",
        "2 0 1 0 2 1 0 0",
        {},
        "expected 9 finite numbers, found",
    ),
    ("s/pair_covisibility.csv", "c-b", "c-x", {}, "'c-x'"),
    ("scaling_factors.csv", "2.5", "long", {}, "long"),
    ("scaling_factors.csv", "s,2.5\n", "", {}, "has none of the scenes"),
]


@pytest.mark.parametrize(("file", "old", "new", "options", "says"), TRAIN_REFUSALS)
def test_a_train_side_that_cannot_be_read_is_refused_by_file(
    train, file, old, new, options, says
):
    text = (train / file).read_text()
    assert old in text
    (train / file).write_text(text.replace(old, new))
    with pytest.raises(UserError, match=re.escape(says)) as refused:
        read_train_side(train, **options)
    # Without options the fault is in the file, and its name is half of the help.
    assert options or new == "" or file in str(refused.value)


def test_a_submission_keeps_its_numbers_and_their_order(tmp_path):
    rng = np.random.default_rng(0)
    names = ["s;5-x", "s;3-x", "a,b", 'a"b', "NA", "a b"]
    rows = {}
    for name in names:
        # F in pixels has elements of very different sizes.
        magnitudes = 10.0 ** rng.integers(-12, 12, (3, 3))
        rows[name] = rng.normal(size=(3, 3)) * magnitudes
    write_submission(tmp_path / "submission.csv", rows)
    read = read_submission(tmp_path / "submission.csv")
    assert list(read) == list(rows)
    for name, F in rows.items():
        assert_allclose(read[name], F, rtol=1e-11, atol=0)  # written with twelve digits
    assert competition.submission_problem(tmp_path / "submission.csv", list(rows)) == ""
    write_submission(tmp_path / "x.csv", {"b": EYE, "a": -EYE / 2})
    expected = b"sample_id,fundamental_matrix\n"
    expected += b"b,1 0 0 0 1 0 0 0 1\na,-0.5 -0 -0 -0 -0.5 -0 -0 -0 -0.5\n"
    # A reader that has the file open, such as an upload, keeps a whole version.
    with (tmp_path / "x.csv").open("rb") as former:
        write_submission(tmp_path / "x.csv", {"b": EYE})
        assert former.read() == expected, "a file is replaced, not overwritten"
    assert list(read_submission(tmp_path / "x.csv")) == ["b"]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("id,F\na,1\n", "missing columns sample_id, fundamental_matrix"),
        ("sample_id,fundamental_matrix\na,{F}\n", "ends before sample b"),
        (
            "sample_id,fundamental_matrix\na,{F}\nb,{F}\nc,{F}\n",
            "line 4: the sample is c, and no more rows was expected",
        ),
        (
            "sample_id,fundamental_matrix\nb,{F}\na,{F}\n",
            "line 2: the sample is b, and a was",
        ),
        (
            "sample_id,fundamental_matrix\na,{F}\nb,1 2 3 4 5 6 7 8 nan\n",
            "line 3: expected 9",
        ),
        (
            "sample_id,fundamental_matrix\na,{F}\nb,0 0 0 0 0 0 0 0 0\n",
            "line 3: the matrix is zero",
        ),
        ("\0\0\0", "missing columns|cannot be read"),
    ],
)
def test_the_first_wrong_line_of_a_submission_is_named(tmp_path, content, says):
    (tmp_path / "x.csv").write_text(content.replace("{F}", "1 2 3 4 5 6 7 8 9"))
    problem = competition.submission_problem(tmp_path / "x.csv", ["a", "b"])
    assert re.search(says, problem)
    problem = competition.submission_problem(tmp_path / "y.csv", ["a"])
    assert "no such file" in problem


@pytest.mark.parametrize(
    ("content", "rows"),
    [
        ("id,value\n007,NA\n\n1e3,\n", [("line 2", ["007", "NA"]), ("line 4", ["1e3", ""])]),
        ('id,value\n"a\nb",2\nc,3\n', [("line 3", ["a\nb", "2"]), ("line 4", ["c", "3"])]),
        ("id,other,value\n 1,x,2 \n", [("line 2", [" 1", "2 "])]),
        ("\ufeffvalue,id\r\n#2,'1'\r\n", [("line 2", ["'1'", "#2"])]),
        ("id,value\r1,2\r\r3,4", [("line 2", ["1", "2"]), ("line 4", ["3", "4"])]),
    ],
)
def test_cells_are_the_text_of_the_file_with_its_lines(tmp_path, content, rows):
    path = tmp_path / "table.csv"
    path.write_bytes(content.encode())
    found = list(read_rows(path, ("id", "value")))
    assert found == [(f"{path}, {where}", cells) for where, cells in rows]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('id,value\n1,"2', "cannot be read as a table: unexpected end of data"),
        ("id,value\n1,2,3", "line 2: the header has 2 cells"),
        ("id,value\n1,2\n3", "line 3: the header has 2 cells"),
        ("id,value\n1," + "2" * 200_000, "cannot be read as a table: field larger than"),
    ],
)
def test_a_table_that_a_reader_would_have_to_guess_at_is_refused(tmp_path, content, says):
    path = tmp_path / "table.csv"
    path.write_text(content)
    with pytest.raises(UserError, match=says):
        list(read_rows(path, ("id", "value")))


def test_missing_images_are_counted_before_the_run(side):
    rows = ["s1,b,a,c", "s2,b,a,none", "s3,empty,x,y"]
    pairs = read_test_side(side(*rows, images=["b/a.png", "b/c.JPG"]))
    line = missing_line(pairs)
    assert line.startswith("missing: 3 of 5 images, the first is ")
    assert line.endswith("test_images/b/none.png")
    assert missing_line(pairs[:1]) == ""


def test_other_formats_stand_for_images_without_the_usual_ones(side):
    images = ["b/a.webp", "b/c.bmp", "b/c.jpg"]
    (pair,) = read_test_side(side("s1,b,a,c", images=images))
    assert pair.names == ("a.webp", "c.jpg")


# Numbers as Python reads them, and other programs do not.
LENIENT = ["1_0", "\u0661", "1\n", "0x1", "nan"]


@pytest.mark.parametrize("number", LENIENT)
def test_numbers_are_read_strictly_in_each_table(tmp_path, train, number):
    matrix = f"{number} 2 3 4 5 6 7 8 9"
    submission = tmp_path / "x.csv"
    submission.write_text(f'sample_id,fundamental_matrix\na,"{matrix}"\n', encoding="utf-8")
    problem = competition.submission_problem(submission, ["a"])
    assert "expected 9 finite numbers" in problem
    with pytest.raises(UserError, match="expected 9 finite numbers"):
        read_submission(submission)
    calibration = train / "s" / "calibration.csv"
    calibration.write_text(
        "image_id,camera_intrinsics,rotation_matrix,translation_vector\n"
        f'a,"{matrix}",1 0 0 0 1 0 0 0 1,0 0 0\n',
        encoding="utf-8",
    )
    with pytest.raises(
        UserError, match=r"calibration\.csv, line .*expected 9 finite numbers"
    ):
        read_train_side(train)
