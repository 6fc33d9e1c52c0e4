"""The score of 2025 against answers by hand."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mkpc_kaggle.cli import main
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.evaluation.imc2025 import DatasetScore, score_dataset, score_imc2025

THRESHOLDS = (0.025, 0.05, 0.1, 0.2, 0.5, 1.0)

Centres = dict[str, np.ndarray]


def scene(name: str, count: int, seed: int = 0) -> Centres:
    """Camera centres within a cube of 20 metres."""
    centres = np.random.default_rng(seed).uniform(-10, 10, (count, 3))
    return {f"{name}{number}": centre for number, centre in enumerate(centres)}


def moved(centres: Mapping[str, np.ndarray], scale: float = 0.3, seed: int = 5) -> Centres:
    """The same in another world."""
    R = Rotation.random(random_state=seed).as_matrix()
    return {name: scale * R @ centre + [3, -1, 7] for name, centre in centres.items()}


def some(centres: Centres, first: int, last: int) -> Centres:
    return dict(list(centres.items())[first:last])


def score(scenes: Mapping[str, Centres], *clusters: Centres) -> DatasetScore:
    named = {f"cluster{number}": cluster for number, cluster in enumerate(clusters)}
    return score_dataset("set", scenes, named, dict.fromkeys(scenes, THRESHOLDS))


@pytest.mark.parametrize("scale", [0.001, 1.0, 50.0])
def test_the_truth_in_another_world_at_any_scale_is_perfect(scale):
    a, b = scene("a", 8), scene("b", 26, seed=1)
    found = score({"a": a, "b": b}, moved(b, scale), moved(a, scale))
    assert (found.maa, found.clusterness, found.score) == (1.0, 1.0, 1.0)


def test_two_scenes_in_one_cluster_halve_the_clusterness_alone():
    a, b = scene("a", 6), scene("b", 6, seed=1)
    found = score({"a": a, "b": b}, moved(a) | moved(b, seed=9))
    assert (found.maa, found.clusterness) == (1.0, 0.5)
    assert found.score == pytest.approx(2 / 3)


def test_of_a_scene_that_was_split_the_largest_part_counts():
    a = scene("a", 10)
    found = score({"a": a}, moved(some(a, 6, 10)), moved(some(a, 0, 6)))
    assert found.maa == pytest.approx((6 - 3) / (10 - 3))
    assert found.clusterness == 1.0


def test_of_two_parts_of_one_size_the_more_accurate_counts():
    a = scene("a", 8)
    wrong = {name: centre[::-1] ** 2 for name, centre in some(a, 0, 4).items()}
    assert score({"a": a}, wrong, moved(some(a, 4, 8))).maa == pytest.approx(1 / 5)


def test_outliers_in_a_cluster_cost_clusterness_and_are_no_scene():
    a, outliers = scene("a", 8), scene("o", 2, seed=3)
    found = score({"a": a, "outliers": outliers}, moved(a) | outliers)
    assert (found.maa, found.clusterness) == (1.0, 0.8)


def test_what_was_called_an_outlier_is_in_no_cluster():
    a = scene("a", 8)
    clusters = {"one": moved(some(a, 0, 6)), "outliers": dict.fromkeys(some(a, 6, 8), np.full(3, np.nan))}
    found = score_dataset("set", {"a": a}, clusters, {"a": THRESHOLDS})
    assert (found.maa, found.clusterness) == (pytest.approx(3 / 5), 1.0)


def test_three_images_fit_any_similarity_and_count_nothing():
    a = scene("a", 6)
    assert score({"a": a}, moved(some(a, 0, 3))).maa == 0
    assert score({"a": some(a, 0, 3)}, moved(some(a, 0, 3))).score == 0


def test_a_part_at_a_wrong_scale_does_not_fit():
    a = scene("a", 10)
    found = score({"a": a}, moved(some(a, 0, 6)) | moved(some(a, 6, 10), 0.6))
    assert found.maa == pytest.approx((6 - 3) / (10 - 3))


def test_a_camera_counts_where_it_is_within_the_threshold_and_the_first_two_are_left_out():
    a = scene("a", 8)
    off = a | {"a0": a["a0"] + [5, 0, 0], "a1": a["a1"] + [0, 0.08, 0]}
    assert score({"a": a}, moved(off)).maa == pytest.approx(4 / 5)  # a1 is beyond the first two alone, a0 all
    assert score({"a": a}, moved(off | {"a1": a["a1"] + [0, 5, 0]})).maa == pytest.approx(3 / 5)


def test_the_scenes_of_a_dataset_are_pooled_not_averaged():
    a, b = scene("a", 5), scene("b", 13, seed=1)
    assert score({"a": a, "b": b}, moved(b)).maa == pytest.approx(10 / (2 + 10))


def test_cameras_without_a_pose_or_at_one_point_fit_nothing():
    a = scene("a", 8)
    assert score({"a": a}, dict.fromkeys(a, np.full(3, np.nan))).maa == 0
    assert score({"a": a}, dict.fromkeys(a, np.zeros(3))).maa == 0


def test_no_cluster_is_a_score_of_zero():
    assert score({"a": scene("a", 5)}).score == 0


LABELS = "dataset,scene,image,rotation_matrix,translation_vector\n"
POSE = "1;0;0;0;1;0;0;0;1"


def write_truth(directory: Path) -> Path:
    rows = [f"set,{name[0]},{name}.png,{POSE},{';'.join(map(str, -c))}\n" for name, c in scene("a", 6).items()]
    rows.append(f"set,outliers,x.png,{';'.join(['nan'] * 9)},nan;nan;nan\n")
    (directory / "train_labels.csv").write_text(LABELS + "".join(rows))
    (directory / "train_thresholds.csv").write_text("dataset,scene,thresholds\nset,a,0.025;0.05;0.1;0.2;0.5;1\n")
    return directory


def test_the_command_scores_a_file(tmp_path, capsys):
    home = write_truth(tmp_path)
    arguments = ["validate", "--imc2025", str(home), "--submission", str(home / "train_labels.csv")]
    assert main(arguments) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[2:] == [["set", "1.0000", "1.0000", "1.0000"], ["mean", "1.0000"]]


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("set,outliers,x.png", "set,outliers,y.png", "2 images of set are missing or unknown, such as x.png"),
        ("set,a,a0.png", "set,a,a1.png", "the image set/a1.png is there twice"),
        (POSE, "1;0;0", "expected 9 and 3 numbers joined by ';', found 3 and 3"),
        (POSE, "north", "'north' is not a list of numbers joined by ';'"),
        ("rotation_matrix", "R", "lacks the columns rotation_matrix"),
    ],
)
def test_a_file_that_is_no_submission_is_refused(tmp_path, before, after, told):
    home = write_truth(tmp_path)
    other = tmp_path / "submission.csv"
    other.write_text((home / "train_labels.csv").read_text().replace(before, after, 1))
    with pytest.raises(UserError, match=told):
        score_imc2025(home, other)


HUGE = POSE.replace("1", "1e308", 1)
ROW = f"set,a,a0.png,{POSE}"


@pytest.mark.parametrize(
    ("table", "before", "after", "told"),
    [
        ("train_labels", POSE, HUGE, "line 2: '1e308;.*' has a number beyond 1e\\+12"),
        (
            "train_labels",
            POSE,
            POSE.replace("1", "nan", 1),
            "train_labels.csv: set/a0.png has no pose, and is not",
        ),
        ("train_labels", POSE, POSE.replace("1", "-inf", 1), "line 2: '-inf;.*' has a number beyond"),
        ("train_labels", None, LABELS, "train_labels.csv has no rows"),
        ("train_thresholds", "0.5;", "nan;", "line 2: expected 3 positive thresholds or more, found '0.025;.*nan"),
        ("train_thresholds", "0.5;", "-0.5;", "expected 3 positive thresholds"),
        ("train_thresholds", "0.5;", "inf;", "has a number beyond"),
        ("train_thresholds", ";0.1;0.2;0.5;1", "", "expected 3 positive thresholds or more, found '0.025;0.05'"),
        ("train_thresholds", "set,a", "set,a,1;2;3\nset,a", "line 3: the scene set/a is there twice"),
        ("train_thresholds", "set,a", "other,a,1;2;3\nset,a", "train_labels.csv lacks the dataset 'other'"),
        ("submission", ROW, f"other,a,a0.png,{POSE},0;0;0\n{ROW}", "submission.csv: .* lacks the dataset 'other'"),
        ("submission", POSE, HUGE, "submission.csv, line 2: '1e308;.*' has a number beyond"),
        ("submission", None, LABELS, "submission.csv has no rows"),
    ],
)
def test_a_table_that_cannot_be_scored_is_refused_in_one_line(tmp_path, capsys, table, before, after, told):
    home = write_truth(tmp_path)
    submission = home / "submission.csv"
    submission.write_text((home / "train_labels.csv").read_text())
    path = home / f"{table}.csv"
    path.write_text(after if before is None else path.read_text().replace(before, after, 1))
    assert main(["validate", "--imc2025", str(home), "--submission", str(submission)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(told, line)


@pytest.mark.parametrize("option", ["--json", "--work-dir"])
def test_an_option_that_scoring_has_no_use_for_is_refused(tmp_path, capsys, option):
    home = write_truth(tmp_path)
    arguments = ["validate", "--imc2025", str(home), "--submission", str(home / "train_labels.csv")]
    assert main([*arguments, option, str(tmp_path / "x")]) == 2
    assert re.search(r"it goes without (--json|--work-dir, )", capsys.readouterr().err)
    assert not (tmp_path / "x").exists()


def test_a_dataset_of_outliers_alone_needs_no_thresholds_and_its_name_is_shown_in_letters(tmp_path, capsys):
    home = write_truth(tmp_path)
    with (home / "train_labels.csv").open("a") as stream:
        stream.write(f"a\x1b[2Jb,outliers,x.png,{';'.join(['nan'] * 9)},nan;nan;nan\n")
    assert main(["validate", "--imc2025", str(home), "--submission", str(home / "train_labels.csv")]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[2:] == [
        ["set", "1.0000", "1.0000", "1.0000"],
        [r"a\x1b[2Jb", "0.0000", "0.0000", "0.0000"],
        ["mean", "0.5000"],
    ]


def test_a_scene_without_thresholds_is_refused(tmp_path):
    home = write_truth(tmp_path)
    (home / "train_thresholds.csv").write_text("dataset,scene,thresholds\n")
    with pytest.raises(UserError, match="has no thresholds of set/a"):
        score_imc2025(home, home / "train_labels.csv")
