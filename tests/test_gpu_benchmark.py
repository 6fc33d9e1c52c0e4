"""The benchmark of a GPU, rehearsed on the CPU, and what becomes of its parts that fail."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.gpu.record import (
    EXPECTED,
)

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_rehearsal_on_the_cpu_runs_every_part(tmp_path):
    command = [sys.executable, "-m", "benchmarks.gpu", "--device", "cpu", "--quick"]
    command += ["--out", str(tmp_path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment.pop("MKPC_WEIGHTS", None)
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert "parts that failed: none" in done.stdout, done.stdout + done.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    parts = {part["name"]: part for part in found["parts"]}
    reasons = {part["name"]: part["reason"] for part in parts.values() if not part["rows"]}
    assert reasons.keys() <= {"trained"}
    networks = parts["networks"]["rows"]
    # What half precision changes depends on the processor.
    assert [row["device and CPU"] for row in networks] == [1.0] * len(networks)
    assert all(row["new"] > row["cached"] > 0 for row in parts["speed"]["rows"])
    # A device-side assert at one place, and at two
    asserts = parts["runs"]["rows"]
    assert [row["verdict"] for row in asserts] == [EXPECTED] * 2, done.stdout
    assert all(row["devices"] == "cpu" and row["errors of calls"] > 0 for row in asserts)
    # The runs' images and journals are gone.
    assert [path.name for path in tmp_path.iterdir()] == ["gpu.json"]
