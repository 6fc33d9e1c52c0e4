"""Workers that are killed at random moments cost a run nothing."""

import random
import threading
import time
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from rectified import matrices, run, sources
from run_tables import matrices_of
from synthetic import RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.engine import process
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.request import Ending


def written(report: Results) -> list[Any]:
    return [matrices(report), matrices_of(report.pairs).tolist(), sources(report)]


@pytest.mark.parametrize("rounds", [1, pytest.param(15, marks=pytest.mark.slow)])
def test_a_run_whose_workers_are_killed_at_random_moments_ends_as_the_undisturbed_one(
    tmp_path, monkeypatch, rounds
):
    pairs = synthetic_pairs(tmp_path / "images")

    def run_whole(name: str) -> Results:
        report = run(pairs, RECIPE, SyntheticMatcher(), tmp_path / name, workers=2)
        assert report.ending is Ending.COMPLETE, report.about.faults
        return report

    start = time.monotonic()
    undisturbed = run_whole("undisturbed")
    whole_s = time.monotonic() - start
    assert undisturbed.about.faults == []
    spawn = process.spawn
    born = count()
    rng = random.Random(0)

    def doomed(name: str, log: Path | None = None) -> Any:
        made, pipe = spawn(name, log)
        number = next(born)
        # One of three: a job that is lost twice is given up.
        if number % 3 == 0:
            # From its imports to the last answer; the first at once, so that one is lost in any case
            seconds = rng.uniform(0.0, whole_s) if number else 0.0
            threading.Timer(seconds, made.kill).start()
        return made, pipe

    monkeypatch.setattr(process, "spawn", doomed)
    faults = []
    for number in range(rounds):
        report = run_whole(f"disturbed {number}")
        assert written(report) == written(undisturbed)
        faults += report.about.faults
    assert faults
    assert all("the worker died: signal SIGKILL" in fault for fault in faults)
