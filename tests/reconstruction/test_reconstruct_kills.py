"""A run over a folder of images that is ended at random moments, in any way, ends with the files of
the undisturbed one.
"""

import csv
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import write_recipe
from test_reconstruct import contents

from mkpc_kaggle.demo import DemoSet

ROUNDS = 4
ENDS = 5  # of each round, before the run that nobody disturbs
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)


def write_inputs(demo: DemoSet, home: Path) -> None:
    """Write photographs with a subfolder, masks of some, and a table with the cameras of others."""
    scene = demo.train_dir / "courtyard"
    images = sorted((scene / "images").iterdir())
    for number, file in enumerate(images):
        folder = home / "images" / ("more" if number > 4 else ".")
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, folder)
    (home / "masks").mkdir()
    for file in images[:4]:
        mask = np.full(cv2.imread(str(file)).shape[:2], 255, np.uint8)
        # The upper border of the images
        mask[:40] = 0
        cv2.imwrite(str(home / "masks" / f"{file.name}.png"), mask)
    rows = ["image,camera_model,width,height,parameters"]
    with (scene / "calibration.csv").open() as stream:
        intrinsics = {
            row["image_id"]: row["camera_intrinsics"] for row in csv.DictReader(stream)
        }
    for file in images[:4]:
        K = np.array(intrinsics[file.stem].split(), float).reshape(3, 3)
        height, width = cv2.imread(str(file)).shape[:2]
        camera = f"SIMPLE_PINHOLE,{width},{height},{K[0, 0]} {K[0, 2] + 0.5} {K[1, 2] + 0.5}"
        rows.append(f"{file.name},{camera}")
    (home / "known.csv").write_text("\n".join([*rows, ""]))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_run_that_is_ended_at_random_moments_ends_with_the_same_files(demo, tmp_path):
    write_inputs(demo, tmp_path)
    write_recipe(
        tmp_path / "small.toml",
        (1, 480),
        (1, 640),
        (2, 640),
        more="[scene]\ncandidates = 4\n",
    )

    def begin(out: str, *more: str) -> "subprocess.Popen[bytes]":
        options = ["--recipe", str(tmp_path / "small.toml"), "--workers", "1"]
        options += ["--masks", str(tmp_path / "masks")]
        options += ["--intrinsics", str(tmp_path / "known.csv"), *more]
        command = ["reconstruct", str(tmp_path / "images"), "--out", str(tmp_path / out)]
        return subprocess.Popen(
            [sys.executable, "-m", "mkpc_kaggle", *command, *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def files_of(out: str) -> dict[str, str]:
        # The journal and the report have times.
        files = contents(tmp_path / out)
        times = ("work/journal", "work/run.log", "work/workers.log", "report.html")
        return {name: text for name, text in files.items() if not name.startswith(times)}

    # Before any run: there is no OUT yet.
    inputs = contents(tmp_path)
    start = time.monotonic()
    assert begin("undisturbed").wait() == 0
    # The end of a run is anywhere within its usual time.
    whole_s = time.monotonic() - start
    expected = files_of("undisturbed")
    assert {
        "database.db",
        "models/0/points3D.bin",
        "sparse/0/points3D.bin",
    } <= expected.keys()
    rng = random.Random(0)
    ended = 0
    for number in range(ROUNDS):
        out = f"out{number}"
        for _ in range(ENDS):
            seconds = rng.uniform(0.0, 0.6 * whole_s)
            way = rng.choice([*SIGNALS, None])
            # The run ends by itself.
            if way is None:
                ended += begin(out, "--time-limit", f"{max(2.0, seconds):.0f}s").wait() != 0
                continue
            process = begin(out)
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                process.send_signal(way)
                ended += 1
            process.wait()
        assert begin(out).wait() == 0
        # A run that ended early has left a scene of fewer matches, too.
        found = files_of(out)
        assert expected.items() <= found.items()
        assert all(name.startswith("work/scenes/") for name in found.keys() - expected.keys())
    assert ended >= ROUNDS
    assert {
        name: text for name, text in contents(tmp_path).items() if name in inputs
    } == inputs
