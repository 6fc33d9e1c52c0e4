"""The benchmark of a GPU, rehearsed on the CPU, and what becomes of its parts that fail."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from benchmarks.gpu import forecast, networks, runs
from benchmarks.gpu.record import (
    EXPECTED,
    Part,
    SkippedError,
    Status,
    TimeIsUpError,
    run_part,
    write,
)
from benchmarks.gpu.setup import Setup
from benchmarks.gpu.speed import RECIPES, cases_of, loads_of
from mkpc_kaggle.recipe import load_recipe

ROOT = Path(__file__).resolve().parents[1]


def part_after(work: Callable[[Part], None], seconds: float = 60.0) -> Part:
    part = Part("own", "Own", until=time.monotonic() + seconds)
    run_part(part, work)
    return part


def test_a_rehearsal_on_the_cpu_runs_every_part(tmp_path):
    command = [sys.executable, "-m", "benchmarks.gpu", "--device", "cpu", "--quick"]
    command += ["--out", str(tmp_path), "--golden", str(tmp_path / "none")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment.pop("MKPC_WEIGHTS", None)
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert "parts that failed: none" in done.stdout, done.stdout + done.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    parts = {part["name"]: part for part in found["parts"]}
    reasons = {part["name"]: part["reason"] for part in parts.values() if not part["rows"]}
    assert reasons.keys() <= {"golden", "trained"}
    assert "no golden vectors" in reasons["golden"]
    networks = parts["networks"]["rows"]
    # What half precision changes depends on the processor.
    assert [row["device and CPU"] for row in networks] == [1.0] * len(networks)
    assert all(row["new"] > row["cached"] > 0 for row in parts["speed"]["rows"])
    # A device-side assert at one place, and at two
    asserts = parts["runs"]["rows"]
    assert [row["verdict"] for row in asserts] == [EXPECTED] * 2, done.stdout
    assert all(row["devices"] == "cpu" and row["errors of calls"] > 0 for row in asserts)
    text = (tmp_path / "gpu.md").read_text()
    assert all(f"## {part['title']}" in text for part in parts.values())
    # The runs' images and journals are gone.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gpu.json", "gpu.md"]


def test_warps_agree_pixel_by_pixel_in_points_and_certainty():
    warp = torch.rand(100, 5) * 50
    moved = warp.clone()
    moved[:10, 3] += 0.2
    doubted = warp.clone()
    doubted[:30, 4] += 0.1
    assert networks._agreement([warp], [warp.clone()], 0.05) == 1.0
    assert networks._agreement([warp], [moved], 0.05) == 0.9
    assert networks._agreement([warp, warp], [warp, doubted], 0.05) == 0.85
    # The same points in another order are matches in common, and another warp.
    assert networks._agreement([warp[:, :4]], [warp[:, :4].flip(0)], 0.05) == 1.0
    assert networks._agreement([warp], [warp.flip(0)], 0.05) < 0.1


def test_an_error_of_a_part_is_recorded_with_its_rows_so_far():
    def work(part: Part) -> None:
        part.add(number=1)
        raise ValueError("no such layer")

    part = part_after(work)
    assert part.status is Status.FAILED
    assert part.rows == [{"number": 1}]
    assert part.reason.endswith("ValueError: no such layer")


def test_an_error_of_a_row_is_recorded_and_the_next_row_follows():
    def work(part: Part) -> None:
        for number in (0, 1):
            with part.row(number=number) as row:
                row["inverse"] = 1 / number

    part = part_after(work)
    assert part.status is Status.DONE
    assert part.rows[0]["error"].endswith("ZeroDivisionError: division by zero")
    assert part.rows[1] == {"number": 1, "inverse": 1.0}
    assert part.surprises == part.rows[:1]


def test_a_part_without_time_is_not_reached_and_one_that_is_cut_keeps_its_rows():
    def work(part: Part) -> None:
        part.add(number=1)
        raise TimeIsUpError

    assert part_after(work, seconds=0.0).status is Status.NOT_REACHED
    cut = part_after(work)
    assert (cut.status, cut.rows) == (Status.CUT, [{"number": 1}])


def test_a_part_that_cannot_run_here_says_why():
    def work(part: Part) -> None:
        raise SkippedError("kornia is missing")

    part = part_after(work)
    assert (part.status, part.reason) == (Status.SKIPPED, "kornia is missing")
    assert not part.surprises


def test_results_are_one_json_file_and_one_page(tmp_path):
    part = Part("own", "Own", Status.DONE, rows=[{"a": 0.123456}, {"b": "x|y\nz"}])
    write(tmp_path, {"device": "cpu"}, [part])
    assert "| 0.1235 |  |" in (tmp_path / "gpu.md").read_text()
    assert "|  | x/y / z |" in (tmp_path / "gpu.md").read_text()
    assert json.loads((tmp_path / "gpu.json").read_text())["parts"][0]["rows"] == part.rows


def test_the_seconds_of_every_unit_of_every_recipe_are_measured():
    names = {case.name for case in cases_of(RECIPES)}
    assert len(names) == len(cases_of(RECIPES))
    assert {"loma l@1024", "loma b128@1024", "roma@864x864!"} <= names


def test_every_matcher_is_measured_before_a_second_size_of_any():
    cases = cases_of(RECIPES)
    loads = loads_of(cases)
    measured = [case for load in loads if load.minibatch > 1 for case in load.cases]
    assert sorted(case.name for case in measured) == sorted(case.name for case in cases)
    kinds = {(case.matcher, case.options) for case in cases}
    assert {(case.matcher, case.options) for case in measured[: len(kinds)]} == kinds
    single = [load.cases[0].name for load in loads if load.minibatch == 1]
    assert single == ["aliked_lightglue@1024", "aliked@1024"]


def test_a_forecast_counts_one_new_image_on_whole_images_and_two_on_crops():
    costs = {"encode": 2.0, "cached": 0.5, "new": 2.5, "minibatch": 8}
    speed = Part("speed", "Speed")
    for name in ("sift@1536", "sift@1280", "sift@1440"):
        speed.rows.append({"matcher": name, "precision": "float32", **costs})
    whole = Setup("cpu", False, Path("out"), None, ())
    part = part_after(lambda part: forecast.measure(part, whole, speed))
    (row, _) = [row for row in part.rows if row["recipe"] == "classical"]
    # Two units on whole images, and one on crops
    assert load_recipe("classical").units[2].stage == 2
    assert row["seconds a pair"] == 2 * (1.0 + 0.5) + (2.0 + 0.5)
    assert row["pairs, 1 GPU"] == int(8.75 * 3600 / 5.5)
    assert row["pairs, 2 GPUs"] == 10_000
    (best, _) = [row for row in part.rows if row["recipe"] == "best"]
    assert best == {"recipe": "best", "precision": "float32", "units measured": "0 of 8"}


@pytest.mark.parametrize(
    ("text", "short", "told"),
    [
        ("", 1, []),
        ("", 2, ["results of 2 pairs are missing, not of 1"]),
        ("", 0, ["results of 0 pairs are missing, not of 1"]),
        ("no worker is started any more on cuda:0", 1, ["a place was closed"]),
        ("matching continues on the cpu: cuda:0", 1, ["the CPU took over"]),
        ("time is up after 28.0s", 8, ["the time was up, with 14 of 16 results"]),
    ],
)
def test_a_bad_pair_may_cost_its_own_results_and_no_place(text, short, told):
    event = {"error": "AcceleratorError: CUDA error: device-side assert triggered", "call": "match"}
    reason = "1:a@64 is skipped on pair 2 (CUDA error: device-side assert triggered)"
    outcome = runs.Outcome(0, f"{text}\n{reason}", 1.0, [event], 14, 16, short, "")
    assert runs.one_pair_is_given_up(outcome) == told
