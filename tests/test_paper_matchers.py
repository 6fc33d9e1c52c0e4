"""Each of the paper's matchers from a checkpoint in the public file's format to submission.csv.

The weights are stand-ins: what is matched has no worth, but it is matched by all of the real code.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from checkpoints import FILES, use_manifest, write_checkpoints
from standin import scene, use_narrow

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import read_submission, read_test_side, submission_problems
from mkpc_kaggle.engine.journal import JournalReader
from mkpc_kaggle.weights import WeightFile

COLUMNS = ("sample_id", "batch_id", "image_1_id", "image_2_id")


@dataclass(frozen=True)
class Trial:
    """``sizes``: what the units of stage 1 and of stage 2 look at; none fits the networks' multiples.

    ``options`` are the matcher's.
    """

    sizes: tuple[str, str]
    options: str = ""


SEMI_DENSE = Trial(("long_side = 209", "long_side = 150"))
TRIALS = {
    "superglue": Trial(("long_side = 209", "long_side = 190")),
    "loftr": SEMI_DENSE,
    "quadtree": SEMI_DENSE,
    "aspanformer": SEMI_DENSE,
    "loma": Trial(
        ("long_side = 209", "long_side = 150"),
        options='variant = "b128"\nmax_keypoints = 300\nmatch_threshold = 0.0',
    ),
    "dkm": Trial(('area = "96x128"', 'area = "70x90"'), options="matches = 300"),
    "roma": Trial(('area = "96x128"', 'area = "70x90"'), options="matches = 300"),
}


class Checkpoints:
    """A directory of stand-in checkpoints, each written when it is first wanted."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    @cache  # noqa: B019  there is only the module's
    def of(self, matcher: str) -> tuple[WeightFile, ...]:
        return write_checkpoints(self.directory, [file for file in FILES if file.matcher == matcher])


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Checkpoints:
    return Checkpoints(tmp_path_factory.mktemp("weights"))


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
    write_pairs(directory, [(f"made;{first}-{second}", "made", first, second) for first, second in pairs])
    return directory


def write_pairs(directory: Path, rows: Sequence[tuple[str, ...]]) -> None:
    with (directory / "test.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])


def write_recipe(directory: Path, matcher: str) -> Path:
    path, trial = directory / "small.toml", TRIALS[matcher]
    units = [f'{{ stage = {n}, matcher = "{matcher}", {size} }}' for n, size in enumerate(trial.sizes, start=1)]
    options = [f"[matchers.{matcher}]", trial.options]
    path.write_text("\n".join([f"units = [{', '.join(units)}]", *options]), encoding="utf-8")
    return path


def matches_found(work_dir: Path) -> dict[tuple[int, int], int]:
    """The matches of each pair's unit by (pair, stage); none of the units may have failed."""
    with JournalReader(work_dir) as journal:
        found = [(index, unit) for index, record in journal.records().items() for unit in record.units]
    assert [unit.failure for _, unit in found] == [""] * len(found)
    return {(index, unit.stage): unit.matches for index, unit in found}


def assert_good(output: Path, test_dir: Path) -> None:
    ids = [pair.id for pair in read_test_side(test_dir)]
    assert submission_problems(output, ids) == []
    for F in read_submission(output).values():
        strengths = np.linalg.svd(F, compute_uv=False)
        assert strengths[2] < 1e-6 * strengths[0] < 1e6 * strengths[1]


@dataclass(frozen=True)
class Made:
    """A submission, and how many matches its units found by (pair, stage)."""

    output: Path
    matches: dict[tuple[int, int], int]


@pytest.fixture
def run(
    clean_environment: None, checkpoints: Checkpoints, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., Made]:
    """A function that makes a submission of a test side with one of the matchers."""

    def made(matcher: str, test_dir: Path, name: str = "submission", *, workers: int = 0) -> Made:
        use_manifest(monkeypatch, checkpoints.of(matcher))
        use_narrow(monkeypatch)
        output, recipe = tmp_path / f"{name}.csv", write_recipe(tmp_path, matcher)
        arguments = ("--test-dir", test_dir, "--output", output, "--recipe", recipe)
        options = ("--weights", checkpoints.directory, "--time-limit", "10m", "--device", "cpu", "--no-report")
        # In this process, so that it meets the manifest that was put in its way.
        assert main(["submit", *map(str, (*arguments, *options, "--workers", workers))]) == 0
        assert_good(output, test_dir)
        return Made(output, matches_found(tmp_path / f"{name}.work"))

    return made


@pytest.mark.parametrize("matcher", TRIALS)
def test_odd_small_and_blank_pictures_go_through(run: Callable[..., Made], matcher: str, made_side: Path) -> None:
    made = run(matcher, made_side)
    assert made.matches.keys() == {(pair, stage) for pair in range(3) for stage in (1, 2)}
    assert made.matches[0, 1] >= 8
    if matcher not in {"dkm", "roma", "loma"}:  # which have answers for all pixels, and keypoints on any picture
        assert made.matches[2, 1] == made.matches[2, 2] == 0


def test_a_worker_process_gives_the_same_bytes(run: Callable[..., Made], made_side: Path) -> None:
    here, there = (run("superglue", made_side, f"with {workers}", workers=workers) for workers in (0, 1))
    assert here.output.read_bytes() == there.output.read_bytes()
