import json
import subprocess
import sys

import numpy as np
import pytest
from run_tables import Described, tables_of
from shared import run_command, scores_of

from mkpc_kaggle.data import competition
from mkpc_kaggle.data.competition import (
    Pair,
    TrainScene,
    TruePair,
    read_test_side,
    read_train_side,
)
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.evaluation.validate import (
    SceneScore,
    Step,
    score_pair,
    score_submission,
    score_table,
    validate,
)
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.metrics import AUC_THRESHOLDS
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


def true_matrices(demo: DemoSet) -> dict[str, np.ndarray]:
    cameras = {}
    for scene in read_train_side(demo.train_dir, min_covisibility=0):
        for true in scene.pairs:
            first = true.pair.images[0].stem
            second = true.pair.images[1].stem
            # The test side may have the two images in the other order.
            cameras[first, second] = true.camera0, true.camera1
            cameras[second, first] = true.camera1, true.camera0
    rows = (line.split(",") for line in demo.truth_csv.read_text().splitlines()[1:])
    return {
        sample: fundamental_of_cameras(*cameras[first, second])
        for sample, _, first, second in rows
    }


def test_the_true_matrices_score_one_in_either_order_of_the_images(demo, tmp_path):
    truth = true_matrices(demo)
    assert list(truth) == [pair.id for pair in read_test_side(demo.test_dir)]
    competition.write_submission(tmp_path / "true.csv", truth)
    train = read_train_side(demo.train_dir)
    scored = score_submission(tmp_path / "true.csv", demo.truth_csv, train)
    assert scored.maa() == 1
    # The file has twelve digits, so errors are not exactly 0.
    aucs = [scored.auc(threshold) for threshold in AUC_THRESHOLDS]
    assert aucs == pytest.approx([1, 1, 1], abs=1e-3)
    assert sum(len(scene.pairs) for scene in scored.scenes) == 8
    lines = score_table(scored)
    assert lines[1].split()[1:3] == ["8", "1.0000"]
    fallbacks = dict.fromkeys(truth, FALLBACK_FUNDAMENTAL)
    competition.write_submission(tmp_path / "fallback.csv", fallbacks)
    scored = score_submission(tmp_path / "fallback.csv", demo.truth_csv, train)
    # The fallback is the F of a sideways motion, so its score need not be 0.
    assert scored.maa() < 0.2


def test_samples_without_a_row_count_as_failed_and_are_named(demo, tmp_path, capsys):
    truth = true_matrices(demo)
    some = tmp_path / "some.csv"
    whole = tmp_path / "whole.csv"
    out = tmp_path / "scores.json"
    competition.write_submission(some, dict(list(truth.items())[:2]))
    competition.write_submission(whole, truth)
    truth_options = ["--train-dir", demo.train_dir, "--truth", demo.truth_csv, "--json", out]
    assert run_command("score", some, *truth_options) == 0
    lacking = list(truth)[2:]
    printed = capsys.readouterr().out
    assert "6 samples without a row, counted as failed: " in printed
    # Five are named at most, so that a wrong file does not fill the screen.
    assert sum(sample in printed for sample in lacking) == 5
    figures = json.loads(out.read_text())
    assert figures["mAA"] == 2 / 8
    assert sorted(figures["missing"]) == sorted(lacking)
    assert run_command("score", some, whole, *truth_options) == 0
    assert [each["mAA"] for each in json.loads(out.read_text())] == [2 / 8, 1]


def test_a_failed_pair_counts_as_failed_even_where_the_fallback_happens_to_be_right():
    eye = np.eye(3)
    camera0 = Camera(eye, eye, np.zeros(3))
    camera1 = Camera(eye, eye, np.array([1.0, 0, 0]))  # the fallback's motion
    true = TruePair(Pair("p", "s", "a", "b"), camera0, camera1, 0.5)
    scene = TrainScene("s", 1.0, (true,))
    tables = tables_of(
        Described("p", failure="too few matches"),
        Described("p", source="pair"),
    )
    failed = score_pair(true, tables.pairs, 0, scene, [Step.MAGSAC])
    right = score_pair(true, tables.pairs, 1, scene)
    assert SceneScore("s", (right, failed, right)).maa() == pytest.approx(2 / 3)
    assert failed.error.rotation == failed.steps[Step.MAGSAC].rotation == np.inf
    assert right.error.angle < 1e-6


def on_demo(demo, recipe, *options):
    return scores_of(
        recipe.with_suffix(".json"),
        "--train-dir",
        demo.train_dir,
        "--recipe",
        recipe,
        *options,
    )


def test_each_step_of_the_estimate_has_a_column(demo, small_recipe, capsys, monkeypatch):
    def watched(scenes, assembly, session, root):
        assert session.status == 1, "the watchdog's, until the scores are printed"
        return validate(scenes, assembly, session, root)

    monkeypatch.setattr("mkpc_kaggle.cli.validate.validate", watched)
    plain = on_demo(demo, small_recipe)
    assert plain["mAA_by_step"] == {"MAGSAC": plain["mAA"]}
    capsys.readouterr()
    small_recipe.write_text(small_recipe.read_text() + "[focal]\n[scene]\n")
    scores = on_demo(demo, small_recipe)
    printed = capsys.readouterr().out
    by_step = scores["mAA_by_step"]
    assert list(by_step) == ["MAGSAC", "+ prior", "+ scene"]
    assert by_step["MAGSAC"] == pytest.approx(plain["mAA"])
    assert by_step["+ scene"] == scores["mAA"]
    # The table and the JSON file are written by two functions.
    (row,) = (
        line.split() for line in printed.splitlines() if line.startswith("mean over scenes")
    )
    assert row[4:7] == [f"{value:.4f}" for value in by_step.values()]
    for pair, former in zip(
        scores["scenes"][0]["pairs"], plain["scenes"][0]["pairs"], strict=True
    ):
        assert pair["accuracy_by_step"]["MAGSAC"] == former["accuracy_by_step"]["MAGSAC"]


# The patched validation never returns.
HANGS = """
import time
from mkpc_kaggle.cli import main, validate
validate.validate = lambda *_, **__: time.sleep(600)
main(["validate", "--train-dir", {train!r}, "--recipe", "classical", "--time-limit", "2s"])
"""


def test_a_validation_that_hangs_ends_at_its_limit(demo):
    code = HANGS.format(train=str(demo.train_dir))
    command = [sys.executable, "-c", code]
    # 300 s are for the imports of a busy machine; the assertions do not depend on them.
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 1
    assert done.stderr.endswith(
        "error: the time limit passed before the scores were printed\n"
    )


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ["--train-dir", "T", "--recipe", "classical", "--set", "magsac.threshold=0"],
            "threshold must be in",
        ),
        (["--train-dir", "T", "--pairs-per-scene", "0"], "give 1 or more"),
        (
            ["--train-dir", "T", "--compare", "classical", "clasical:stage-1"],
            "unknown recipe 'clasical'",
        ),
        (["--train-dir", "T", "--compare", "classical"], "two recipes"),
    ],
)
def test_contradictory_options_are_refused(demo, options, told, capsys):
    places = {"T": demo.train_dir}
    assert run_command("validate", *(places.get(option, option) for option in options)) == 2
    captured = capsys.readouterr()
    assert (told in captured.err, captured.out) == (True, "")
