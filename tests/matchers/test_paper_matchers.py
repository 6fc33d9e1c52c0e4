"""Each of the paper's matchers from a checkpoint in the public file's format to submission.csv.

The weights are stand-ins: what is matched has no worth, but it is matched by all of the real code.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from checkpoints import FILES, use_manifest, write_checkpoints
from standin import scene, use_narrow

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import read_submission, read_test_side, submission_problems
from mkpc_kaggle.engine.journal_reader import JournalReader
from mkpc_kaggle.weights import WeightFile

# What the units of stages 1 and 2 look at, which fits no network's multiple, and the matcher's options.
TRIALS = {
    "superglue": ("long_side = 209", "long_side = 190", ""),
    "loftr": ("long_side = 209", "long_side = 150", ""),
    "quadtree": ("long_side = 209", "long_side = 150", ""),
    "aspanformer": ("long_side = 209", "long_side = 150", ""),
    "loma": ("long_side = 209", "long_side = 150", 'variant = "b128"\nmax_keypoints = 300\nmatch_threshold = 0.0'),
    "dkm": ('area = "96x128"', 'area = "70x90"', "matches = 300"),
    "roma": ('area = "96x128"', 'area = "70x90"', "matches = 300"),
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("weights")


@cache
def checkpoints(directory: Path, matcher: str) -> tuple[WeightFile, ...]:
    """The matcher's stand-in checkpoints, written when they are first wanted."""
    return write_checkpoints(directory, [file for file in FILES if file.matcher == matcher])


@pytest.fixture(scope="module")
def made_side(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odd sizes, landscape and portrait, one picture without texture, one of 33 x 47 pixels."""
    directory = tmp_path_factory.mktemp("made")
    whole = scene(240, 240, channels=3)
    pictures = {
        "landscape": whole[64:203, 16:225],
        "portrait": whole[16:225, 40:179],
        "small": whole[120:167, 80:113],
        "blank": np.zeros((131, 175, 3), np.uint8),
    }
    for name, pixels in pictures.items():
        path = directory / "test_images" / "made" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), pixels)
    pairs = [("landscape", "portrait"), ("small", "landscape"), ("portrait", "blank")]
    rows = [f"made;{first}-{second},made,{first},{second}" for first, second in pairs]
    (directory / "test.csv").write_text("\n".join(["sample_id,batch_id,image_1_id,image_2_id", *rows]))
    return directory


def write_recipe(directory: Path, matcher: str) -> Path:
    path, (*sizes, options) = directory / "small.toml", TRIALS[matcher]
    units = [f'{{ stage = {n}, matcher = "{matcher}", {size} }}' for n, size in enumerate(sizes, start=1)]
    path.write_text(f"units = [{', '.join(units)}]\n[matchers.{matcher}]\n{options}", encoding="utf-8")
    return path


def matches_found(work_dir: Path) -> dict[tuple[int, int], int]:
    """The matches of each pair's unit by (pair, stage); none of the units may have failed."""
    with JournalReader(work_dir) as journal:
        found = [(record.index, unit) for record in journal.records() for unit in record.units]
    assert [unit.failure for _, unit in found] == [""] * len(found)
    return {(index, unit.stage): unit.matches for index, unit in found}


def assert_good(output: Path, test_dir: Path) -> None:
    ids = [pair.id for pair in read_test_side(test_dir)]
    assert submission_problems(output, ids) == []
    for F in read_submission(output).values():
        strengths = np.linalg.svd(F, compute_uv=False)
        assert strengths[2] < 1e-6 * strengths[0] < 1e6 * strengths[1]


@pytest.fixture
def run(
    clean_environment, weights, monkeypatch, tmp_path
) -> Callable[..., tuple[bytes, dict[tuple[int, int], int]]]:
    """A function that makes a submission of a test side with one of the matchers.

    It returns the file, and how many matches its units found by (pair, stage).
    """

    def made(matcher, test_dir, *, workers=0):
        use_manifest(monkeypatch, checkpoints(weights, matcher))
        use_narrow(monkeypatch)
        output, recipe = tmp_path / f"{workers}.csv", write_recipe(tmp_path, matcher)
        arguments = ("--test-dir", test_dir, "--output", output, "--recipe", recipe)
        options = ("--weights", weights, "--time-limit", "10m", "--device", "cpu", "--no-report")
        # In this process, so that it meets the manifest that was put in its way.
        assert main(["submit", *map(str, (*arguments, *options, "--workers", workers))]) == 0
        assert_good(output, test_dir)
        return output.read_bytes(), matches_found(tmp_path / f"{workers}.work")

    return made


@pytest.mark.parametrize("matcher", TRIALS)
def test_odd_small_and_blank_pictures_go_through(run, matcher, made_side):
    _, matches = run(matcher, made_side)
    assert matches.keys() == {(pair, stage) for pair in range(3) for stage in (1, 2)}
    assert matches[0, 1] >= 8
    if matcher not in {"dkm", "roma", "loma"}:  # which have answers for all pixels, and keypoints on any picture
        assert matches[2, 1] == matches[2, 2] == 0


def test_a_worker_process_gives_the_same_bytes(run, made_side):
    here, there = (run("superglue", made_side, workers=workers) for workers in (0, 1))
    assert here == there
