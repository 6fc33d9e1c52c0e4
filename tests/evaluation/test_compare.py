import json
import re
import shutil
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared import run_command

from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.evaluation.validate import paired_difference

PAIRS = [*combinations("abcdef", 2)]
tenths = st.lists(
    st.integers(0, 10).map(lambda count: count / 10), min_size=1, max_size=len(PAIRS)
)


def test_scenes_have_equal_weights_regardless_of_their_number_of_pairs():
    large = ([0.0] * 9, [0.2] * 9, PAIRS[:9])
    small = ([0.0], [0.4], PAIRS[:1])
    difference = paired_difference([large, small])
    # Over the ten pairs, the mean would be 0.22.
    assert (difference.gain, difference.low, difference.high) == pytest.approx(
        (0.3, 0.3, 0.3)
    )


@settings(max_examples=30, deadline=None)
@given(st.lists(tenths, min_size=1, max_size=3), st.randoms(use_true_random=False))
def test_the_interval_holds_the_gain_and_changes_its_sign_with_exchanged_recipes(
    firsts, random
):
    scenes = [
        (first, random.sample(first, len(first)), PAIRS[: len(first)]) for first in firsts
    ]
    one = paired_difference(scenes)
    assert one == paired_difference(scenes)
    assert one.low - 1e-9 <= one.gain <= one.high + 1e-9
    other = paired_difference([(second, first, images) for first, second, images in scenes])
    assert (other.gain, other.low, other.high) == pytest.approx(
        (-one.gain, -one.high, -one.low)
    )


def test_95_percent_intervals_hold_the_true_gain_if_gains_depend_on_images():
    """Two scenes of 16 images, all pairs. A pair gains the sum of its images' gains, and noise."""
    generator = np.random.default_rng(7)
    held = 0
    trials = 60
    ends = [*combinations(range(16), 2)]
    names = [(str(a), str(b)) for a, b in ends]
    for _ in range(trials):
        scenes = []
        for gain in (0.08, 0.0):
            image = generator.normal(gain / 2, 0.1, 16)
            of_pairs = image[ends].sum(axis=1) + generator.normal(0, 0.2, 120)
            scenes.append((np.zeros(120), of_pairs, names))
        difference = paired_difference(scenes)
        held += difference.low <= 0.04 <= difference.high
    # Pairs that share an image are not independent: resampling pairs gives too narrow intervals.
    assert 0.88 <= held / trials <= 0.99


def compare(demo: DemoSet, *more: str) -> int:
    few = ["--train-dir", demo.train_dir, "--pairs-per-scene", 4, "--workers", 0]
    return run_command("validate", *few, *more)


def test_a_comparison_prints_the_gain_and_its_second_run_prints_it_without_matching(
    demo, small_recipe, tmp_path, capsys
):
    out = tmp_path / "scores.json"
    compared = f"{small_recipe}:whole-images", str(small_recipe)
    arguments = ["--compare", *compared, "--work-dir", tmp_path / "work"]
    assert compare(demo, *arguments, "--json", out) == 0
    table = capsys.readouterr().out.split("\nrecipe ")[-1]
    runs = json.loads(out.read_text())
    assert [run["recipe"] for run in runs] == ["small (whole-images)", "small"]
    naive, split = (run["mAA"] for run in runs)
    last = table.splitlines()[-1]
    assert re.fullmatch(rf"mean over scenes +4  \{split - naive:+.4f} \[.*\]", last)

    assert compare(demo, *arguments) == 0  # nothing is left to do: the journals tell the same
    again = capsys.readouterr().out
    assert again.count("4 pairs from earlier runs") == 2
    assert again.split("\nrecipe ")[-1] == table


def test_a_comparison_of_runs_that_failed_or_ended_early_has_their_status(
    demo, small_recipe, tmp_path, capsys
):
    train = shutil.copytree(demo.train_dir, tmp_path / "train")
    for image in train.rglob("*.jpg"):
        image.write_bytes(b"no picture")
    recipes = [f"{small_recipe}:stage-1", f"{small_recipe}:whole-images"]
    compared = ["--pairs-per-scene", "2", "--compare", *recipes]
    assert run_command("validate", "--train-dir", train, *compared, "--workers", 0) == 1
    printed = capsys.readouterr().out
    assert printed.count("the run failed: 2 of 2 pairs got no F because of errors") == 2
    assert "gain of mAA" in printed
    # A second is over before the first pair is matched, so no scores can be compared.
    assert compare(demo, *compared, "--time-limit", "1s") == 1
    printed = capsys.readouterr().out
    assert "nothing is compared" in printed
    assert "gain of mAA" not in printed
