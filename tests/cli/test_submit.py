"""``make_submission.py`` as a person runs it: a process, real pictures, files on disk."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from shared import problems_of, run_command

from mkpc_kaggle.errors import UserError

ROOT = Path(__file__).resolve().parents[2]
HERE = ("--no-report", "--workers", "0")  # in one process


def command(test_dir: Path, output: Path, recipe: Path | str, *more: str) -> list[str]:
    paths = ["--test-dir", str(test_dir), "--output", str(output), "--recipe", str(recipe)]
    return [sys.executable, str(ROOT / "make_submission.py"), *paths, *more]


def make(*paths: Path | str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "MKPC_WEIGHTS"}
    return subprocess.run(command(*paths), capture_output=True, text=True, env=environment, check=False)


def test_a_submission_is_made_resumed_and_computed_again_where_a_unit_changed(demo, small_recipe, tmp_path):
    output = tmp_path / "submission.csv"
    first = make(demo.test_dir, output, small_recipe)
    assert first.returncode == 0, first.stderr
    assert "complete after" in first.stdout
    assert problems_of(output, demo.test_dir) == []
    written = output.read_bytes()
    second = make(demo.test_dir, output, small_recipe, *HERE)
    assert "8 of them from earlier runs" in second.stdout
    assert output.read_bytes() == written
    small_recipe.write_text(small_recipe.read_text().replace("400", "401"))
    assert "8 units run" in make(demo.test_dir, output, small_recipe, *HERE).stdout
    changed = output.read_bytes()
    assert changed != written
    assert "16 units run" in make(demo.test_dir, output, small_recipe, "--fresh", *HERE).stdout
    assert output.read_bytes() == changed


def test_a_killed_run_goes_on_and_ends_with_the_bytes_of_an_undisturbed_one(demo, small_recipe, tmp_path):
    undisturbed, output = tmp_path / "undisturbed.csv", tmp_path / "submission.csv"
    make(demo.test_dir, undisturbed, small_recipe, *HERE)
    begun = command(demo.test_dir, output, small_recipe, "--no-report")
    running = subprocess.Popen(begun, stderr=subprocess.PIPE, text=True)
    for line in running.stderr:  # the progress: the first deepened pair
        if line.startswith("deepen"):
            break
    running.send_signal(signal.SIGKILL)
    running.wait()
    running.stderr.close()
    assert problems_of(output, demo.test_dir) == []
    resumed = make(demo.test_dir, output, small_recipe, *HERE)
    assert resumed.returncode == 0, resumed.stderr
    assert output.read_bytes() == undisturbed.read_bytes()


def test_a_limit_that_is_over_at_the_start_leaves_a_whole_file_and_is_told(demo, tmp_path):
    made = make(demo.test_dir, tmp_path / "submission.csv", "classical", "--time-limit", "0.1s")
    assert made.returncode == 1
    assert "the time limit passed before the first results were written" in made.stderr
    assert problems_of(tmp_path / "submission.csv", demo.test_dir) == []


OF_ANOTHER = "sample_id,fundamental_matrix\nof another test set,0 0 0 0 0 0 0 0 0\n"


@pytest.mark.parametrize("former", [None, "", OF_ANOTHER])
def test_a_whole_submission_is_there_before_weights_and_devices_are_looked_at(demo, tmp_path, monkeypatch, former):
    def look(*_, **__):
        assert problems_of(output, demo.test_dir) == []
        raise UserError("the disk with the weights cannot be read")

    monkeypatch.setattr("mkpc_kaggle.cli.options.assemble", look)
    output = tmp_path / "submission.csv"
    if former is not None:
        output.write_text(former)
    assert run_command("submit", "--test-dir", demo.test_dir, "--output", output) == 2
    left = output.read_text() if output.exists() else None
    assert left == former, "a run that is refused leaves what there was"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["submit --test-dir {test}", "reconstruct {test}/test_images --out out"])
def test_a_signal_ends_the_reading_of_weights(
    demo, tmp_path, clean_environment, monkeypatch, number, command, capsys
):
    def read_for_long(path):
        os.kill(os.getpid(), number)
        for _ in range(100):
            time.sleep(0.01)
        pytest.fail("it is read on for a second")

    monkeypatch.setattr("mkpc_kaggle.weights.store.digest_of", read_for_long)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "superglue_outdoor.pth").touch()  # whose size the manifest does not have
    status = run_command(*command.format(test=demo.test_dir).split(), "--recipe", "auto", "--weights", "weights")
    assert status == 128 + number
    assert capsys.readouterr().err == "error: interrupted\n"
    if command.startswith("submit"):
        assert problems_of(tmp_path / "submission.csv", demo.test_dir) == []
