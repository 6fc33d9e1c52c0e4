"""The score of 2025 against answers by hand."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared import run_command

from mkpc_kaggle.evaluation.imc2025 import DatasetScore, score_dataset

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


A = scene("a", 10)
B = scene("b", 26, seed=1)
OUTLIERS = scene("o", 2, seed=3)
# A mirrored and bent scene, which no similarity maps to the true one.
WRONG = {name: centre[::-1] ** 2 for name, centre in some(A, 5, 10).items()}
OFF = A | {"a0": A["a0"] + [5, 0, 0]}
NO_POSE = np.full(3, np.nan)


@pytest.mark.parametrize(
    ("scenes", "clusters", "maa", "clusterness"),
    [
        ({"a": A, "b": B}, [moved(B, 0.001), moved(A, 50)], 1, 1),
        ({"a": A, "b": some(B, 0, 10)}, [moved(A) | moved(some(B, 0, 10), seed=9)], 1, 0.5),
        # Of a split scene the largest part
        ({"a": A}, [moved(some(A, 6, 10)), moved(some(A, 0, 6))], 3 / 7, 1),
        ({"a": A}, [WRONG, moved(some(A, 0, 5))], 2 / 7, 1),  # of equal parts the more accurate
        ({"a": some(A, 0, 8), "outliers": OUTLIERS}, [moved(some(A, 0, 8)) | OUTLIERS], 1, 0.8),
        ({"a": A}, [moved(some(A, 0, 3))], 0, 1),  # three images fit any similarity
        # A part at a wrong scale
        ({"a": A}, [moved(some(A, 0, 6)) | moved(some(A, 6, 10), 0.6)], 3 / 7, 1),
        # Without the first two thresholds
        ({"a": A}, [moved(OFF | {"a1": A["a1"] + [0, 0.08, 0]})], 6 / 7, 1),
        ({"a": A}, [moved(OFF | {"a1": A["a1"] + [0, 5, 0]})], 5 / 7, 1),
        ({"a": A, "b": B}, [moved(B)], 23 / (7 + 23), 1),  # scenes are pooled, not averaged
        ({"a": A}, [dict.fromkeys(A, NO_POSE)], 0, 1),
        ({"a": A}, [dict.fromkeys(A, np.zeros(3))], 0, 1),
        ({"a": A}, [], 0, 0),
    ],
)
def test_the_score_is_the_harmonic_mean_of_accuracy_and_clusterness_computed_by_hand(
    scenes, clusters, maa, clusterness
):
    # A similarity has seven degrees of freedom: three of the images always fit and do not count.
    found = score(scenes, *clusters)
    assert (found.maa, found.clusterness) == pytest.approx((maa, clusterness))
    both = maa + clusterness
    assert found.score == pytest.approx(2 * maa * clusterness / both if both else 0)


def test_images_that_are_called_outliers_are_in_no_cluster():
    clusters = {"one": moved(some(A, 0, 6)), "outliers": dict.fromkeys(some(A, 6, 10), NO_POSE)}
    found = score_dataset("set", {"a": A}, clusters, {"a": THRESHOLDS})
    assert (found.maa, found.clusterness) == (pytest.approx(3 / 7), 1.0)


LABELS = "dataset,scene,image,rotation_matrix,translation_vector\n"
POSE = "1;0;0;0;1;0;0;0;1"


def write_truth(directory: Path) -> Path:
    rows = []
    for name, centre in scene("a", 6).items():
        t = ";".join(map(str, -centre))
        rows.append(f"set,{name[0]},{name}.png,{POSE},{t}\n")
    rows.append(f"set,outliers,x.png,{';'.join(['nan'] * 9)},nan;nan;nan\n")
    (directory / "train_labels.csv").write_text(LABELS + "".join(rows))
    thresholds = "dataset,scene,thresholds\nset,a,0.025;0.05;0.1;0.2;0.5;1\n"
    (directory / "train_thresholds.csv").write_text(thresholds)
    return directory


HUGE = POSE.replace("1", "1e308", 1)
ROW = f"set,a,a0.png,{POSE}"


@pytest.mark.parametrize(
    ("table", "before", "after", "told"),
    [
        # Squares of 1e308 overflow, and NumPy would warn in the middle of a score.
        ("train_labels", POSE, HUGE, "line 2: '1e308;.*' has a number beyond 1e\\+12"),
        (
            "train_labels",
            POSE,
            POSE.replace("1", "nan", 1),
            "labels.csv: set/a0.png has no pose, and is not",
        ),
        ("train_labels", None, LABELS, "train_labels.csv has no rows"),
        ("train_thresholds", "set,a,", "set,b,", "has no thresholds of set/a"),
        (
            "train_thresholds",
            "0.5;",
            "nan;",
            "line 2: expected 3 positive thresholds or more, found '0.025;.*nan",
        ),
        (
            "train_thresholds",
            "set,a",
            "set,a,1;2;3\nset,a",
            "line 3: the scene set/a is there twice",
        ),
        (
            "train_thresholds",
            "set,a",
            "other,a,1;2;3\nset,a",
            "train_labels.csv lacks the dataset 'other'",
        ),
        (
            "submission",
            ROW,
            f"other,a,a0.png,{POSE},0;0;0\n{ROW}",
            "submission.csv: .* lacks the dataset 'other'",
        ),
        ("submission", None, LABELS, "submission.csv has no rows"),
        (
            "submission",
            "outliers,x",
            "outliers,y",
            "2 images of set missing or unknown, such as x",
        ),
        ("submission", "set,a,a0.png", "set,a,a1.png", "the image set/a1.png is there twice"),
        ("submission", POSE, "1;0;0", "expected 9 and 3 numbers joined by ';', found 3 and 3"),
        ("submission", POSE, "north", "'north' is not a list of numbers joined by ';'"),
        ("submission", "rotation_matrix", "R", "missing columns rotation_matrix"),
    ],
)
def test_a_table_that_cannot_be_scored_is_refused_in_one_line(
    tmp_path, capsys, table, before, after, told
):
    home = write_truth(tmp_path)
    submission = home / "submission.csv"
    submission.write_text((home / "train_labels.csv").read_text())
    path = home / f"{table}.csv"
    path.write_text(after if before is None else path.read_text().replace(before, after, 1))
    assert run_command("score", submission, "--imc2025", home) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(told, line)


def test_the_command_scores_a_file_and_a_dataset_of_outliers_alone_needs_no_thresholds(
    tmp_path, capsys
):
    home = write_truth(tmp_path)
    with (home / "train_labels.csv").open("a") as stream:
        stream.write(f"a\x1b[2Jb,outliers,x.png,{';'.join(['nan'] * 9)},nan;nan;nan\n")
    # The truth as a submission; a dataset's name may drive a terminal.
    truth = home / "train_labels.csv"
    assert run_command("score", truth, "--imc2025", home) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[2:] == [
        ["set", "1.0000", "1.0000", "1.0000"],
        [r"a\x1b[2Jb", "0.0000", "0.0000", "0.0000"],
        ["mean", "0.5000"],
    ]
