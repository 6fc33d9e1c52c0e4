"""``make_submission.py`` as a person runs it: a process, real pictures, files on disk."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from genuine import GENUINE
from shared import DATA, needs_data, problem_of, run_command, write_small_recipe

from mkpc_kaggle.data.competition import Pair, write_submission
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.session import first_version
from mkpc_kaggle.errors import UserError

ROOT = Path(__file__).resolve().parents[2]


def command(test_dir: Path, output: Path, recipe: Path | str, *more: str) -> list[str]:
    paths = ["--test-dir", str(test_dir), "--output", str(output), "--recipe", str(recipe)]
    return [sys.executable, str(ROOT / "make_submission.py"), *paths, *more]


def make(*paths: Path | str) -> subprocess.CompletedProcess[str]:
    environment = dict(os.environ)
    environment.pop("MKPC_WEIGHTS", None)  # of the person who runs the tests
    done = command(*paths)
    return subprocess.run(done, capture_output=True, text=True, env=environment, check=False)


@pytest.fixture(scope="module")
def made(
    demo: DemoSet, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, bytes, subprocess.CompletedProcess[str]]:
    """A submission that the script has made, its bytes, and how the script ended."""
    home = tmp_path_factory.mktemp("made")
    done = make(demo.test_dir, home / "submission.csv", write_small_recipe(home))
    return home / "submission.csv", (home / "submission.csv").read_bytes(), done


def submit(test_dir: Path, output: Path, recipe: Path, *more: str) -> int:
    """Submit in this process."""
    paths = ["--test-dir", test_dir, "--output", output, "--recipe", recipe]
    return run_command("submit", *paths, "--no-report", "--workers", 0, *more)


def test_a_submission_is_made_resumed_and_made_again_from_nothing(
    demo, small_recipe, made, capsys
):
    output, written, done = made
    assert done.returncode == 0, done.stderr
    assert "complete after" in done.stdout
    assert problem_of(output, demo.test_dir) == ""
    assert submit(demo.test_dir, output, small_recipe) == 0
    assert "8 pairs from earlier runs" in capsys.readouterr().out
    assert output.read_bytes() == written
    assert submit(demo.test_dir, output, small_recipe, "--fresh") == 0
    # Two units on each of eight pairs.
    assert "16 units run" in capsys.readouterr().out
    assert output.read_bytes() == written


def test_a_killed_run_resumes_and_ends_with_the_bytes_of_an_undisturbed_one(
    demo, small_recipe, made, tmp_path
):
    output = tmp_path / "submission.csv"
    begun = command(demo.test_dir, output, small_recipe, "--no-report")
    running = subprocess.Popen(begun, stderr=subprocess.DEVNULL)
    log = tmp_path / "submission.work" / "run.log"
    while not (log.exists() and "deepen" in log.read_text()):
        time.sleep(0.01)
        assert running.poll() is None
    running.send_signal(signal.SIGKILL)
    running.wait()
    assert problem_of(output, demo.test_dir) == ""
    assert submit(demo.test_dir, output, small_recipe) == 0
    assert output.read_bytes() == made[1]


def test_a_limit_that_is_over_at_the_start_leaves_a_whole_file_and_a_message(demo, tmp_path):
    # Imports alone take longer than 0.1 s.
    made = make(
        demo.test_dir, tmp_path / "submission.csv", "classical", "--time-limit", "0.1s"
    )
    assert made.returncode == 1
    assert "the time limit passed before the first results were written" in made.stderr
    assert problem_of(tmp_path / "submission.csv", demo.test_dir) == ""


# An empty file, and the rows of another competition
OF_ANOTHER = "sample_id,fundamental_matrix\nof another test set,0 0 0 0 0 0 0 0 0\n"


@pytest.mark.parametrize("former", ["", OF_ANOTHER])
def test_a_whole_submission_exists_before_weights_and_devices_are_searched(
    demo, tmp_path, monkeypatch, former
):
    # Weights on a slow disk, or a GPU's driver that hangs, must not cost the file.
    def look(*_, **__):
        assert problem_of(output, demo.test_dir) == ""
        raise UserError("the disk with the weights cannot be read")

    monkeypatch.setattr("mkpc_kaggle.cli.options.assemble", look)
    output = tmp_path / "submission.csv"
    output.write_text(former)
    assert run_command("submit", "--test-dir", demo.test_dir, "--output", output) == 2
    assert problem_of(output, demo.test_dir) == ""


def test_a_former_submission_stays_and_is_copied_where_the_disk_takes_it(tmp_path):
    output = tmp_path / "submission.csv"
    write_submission(output, {"x": np.eye(3)})
    text = output.read_text()
    first_version([Pair("x", "", "a", "b")], output, tmp_path)
    (copy,) = tmp_path.glob("earlier-*.csv")
    # A file for a directory, as a disk that takes nothing
    first_version([Pair("x", "", "a", "b")], output, copy)
    assert output.read_text() == copy.read_text() == text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    "command", ["submit --test-dir {test}", "reconstruct {test}/test_images --out out"]
)
def test_a_signal_ends_the_reading_of_weights(
    demo, tmp_path, clean_environment, monkeypatch, number, command, capsys
):
    # Digesting 3 GB of weights takes long on a slow disk, and Ctrl-C must work meanwhile.
    def read_for_long(path):
        os.kill(os.getpid(), number)
        for _ in range(100):
            time.sleep(0.01)
        pytest.fail("it is read on for a second")

    monkeypatch.setattr("mkpc_kaggle.weights.store.digest_of", read_for_long)
    (tmp_path / "weights").mkdir()
    # The manifest does not have its size, so it must be digested.
    (tmp_path / "weights" / "superglue_outdoor.pth").touch()
    words = command.format(test=demo.test_dir).split()
    status = run_command(*words, "--recipe", "auto", "--weights", "weights")
    assert status == 128 + number  # as shells report a signal
    assert capsys.readouterr().err == "error: interrupted\n"
    if command.startswith("submit"):
        assert problem_of(tmp_path / "submission.csv", demo.test_dir) == ""


@pytest.mark.genuine
@needs_data
def test_the_light_recipe_with_genuine_weights_matches_photographs_with_aliked_and_lightglue(
    tmp_path,
):
    """On a pair of the competition."""
    rows = (DATA / "test" / "test.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "test.csv").write_text("\n".join([rows[0], rows[3]]), encoding="utf-8")
    (tmp_path / "test_images").symlink_to(DATA / "test" / "test_images")
    output = tmp_path / "submission.csv"
    done = make(tmp_path, output, "light", "--no-report", "--weights", str(GENUINE))
    assert done.returncode == 0, done.stderr
    assert "1 of 1 pair with an F" in done.stdout
    faults = "left out|without an F|without 1:"
    assert not re.search(faults, done.stdout + done.stderr)
    units = results(tmp_path / "submission.work").units
    # A pair that does not need the crops has none of their matches.
    counts = units["matches"][units["unit"].str.contains("1:aliked_lightglue@")].tolist()
    assert len(counts) == 1
    # Networks with wrong weights find a handful.
    assert counts[0] > 100
