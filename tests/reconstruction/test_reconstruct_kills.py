"""A run over folders of images that is killed at random moments ends with the files of the
undisturbed one.
"""

import random
import shutil
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from shared import write_recipe
from test_reconstruct import contents

ROUNDS, KILLS = 4, 5  # of each round, before the run that nobody disturbs


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_run_that_is_killed_at_random_moments_ends_with_the_same_files(demo, tmp_path):
    """Two datasets; in one of them an image lies on a side."""
    images = sorted((demo.train_dir / "courtyard" / "images").iterdir())
    for name, files in (("a", images[:3]), ("b", images)):
        (tmp_path / "images" / name).mkdir(parents=True)
        for file in files:
            shutil.copy(file, tmp_path / "images" / name)
    lying = tmp_path / "images" / "b" / images[4].name
    cv2.imwrite(str(lying), np.rot90(cv2.imread(str(lying))))

    def begin(out: str) -> "subprocess.Popen[bytes]":
        recipe = str(tmp_path / "small.toml")
        options = ["--recipe", recipe, "--rotations", "--format", "imc2025", "--workers", "1"]
        command = [
            "-m",
            "mkpc_kaggle",
            "reconstruct",
            str(tmp_path / "images"),
            "--out",
            str(tmp_path / out),
        ]
        return subprocess.Popen([sys.executable, *command, *options], stdout=subprocess.DEVNULL)

    def files_of(out: str) -> dict[str, str]:
        found = contents(tmp_path / out)
        del found["report.html"], found["summary.json"]  # they tell of times
        return found

    write_recipe(tmp_path / "small.toml", (1, 320), (2, 400))
    start = time.monotonic()
    assert begin("undisturbed").wait() == 0
    whole_s, expected, rng = time.monotonic() - start, files_of("undisturbed"), random.Random(0)
    assert {
        "a/database.db",
        "b/models/0/points3D.bin",
        "b/sparse/0/points3D.bin",
        "cameras.csv",
        "submission.csv",
    } <= expected.keys()
    kills = 0
    for number in range(ROUNDS):
        for _ in range(KILLS):
            process = begin(f"out{number}")
            try:
                process.wait(rng.uniform(0.0, 0.6 * whole_s))
            except subprocess.TimeoutExpired:
                process.kill()
                kills += 1
            process.wait()
        assert begin(f"out{number}").wait() == 0
        assert files_of(f"out{number}") == expected
    assert kills >= ROUNDS
