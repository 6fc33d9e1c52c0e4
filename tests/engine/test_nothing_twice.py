"""Nothing is computed twice: what runs after a change, and that the result has the bytes of a fresh
run.
"""

import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from faulty import FaultyMatcher, lack_an_image
from rectified import THREE_UNITS, RectifiedMatcher, matrices, run
from simulator import Scenario, memory_store, simulate

from mkpc_kaggle.cli import main
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.request import Ending

FIRST = '{ stage = 1, matcher = "sift", long_side = 320 }'


SECOND = '{ stage = 2, matcher = "sift", long_side = 400 }'


THIRD = '{ stage = 1, matcher = "sift", long_side = 256 }'


BEFORE = 6  # rows of the test side before the change, of 8


@dataclass
class Room:
    """A test side, a recipe, and a run of them."""

    home: Path

    @property
    def table(self) -> Path:
        return self.home / "test" / "test.csv"

    @property
    def recipe(self) -> Path:
        return self.home / "small.toml"

    def units(self, *units: str, more: str = "") -> None:
        # Quick estimates, with all kinds of results: units, F under a prior, scenes
        magsac = "[magsac]\nmax_iterations = 2000\n"
        others = "[focal]\n[scene]\npairs_per_image = 0\n"
        self.recipe.write_text(f"units = [{', '.join(units)}]\n{magsac}{more}\n{others}")

    def rows(self, count: int) -> None:
        lines = (self.home / "rows.csv").read_text().splitlines()
        self.table.write_text("\n".join(lines[: count + 1]) + "\n")

    def command(self, output: str) -> list[str]:
        files = ["--test-dir", str(self.home / "test"), "--output", str(self.home / output)]
        return [
            "submit",
            *files,
            "--recipe",
            str(self.recipe),
            "--no-report",
            "--workers",
            "0",
        ]

    def run(self, output: str = "a.csv") -> bytes:
        assert main(self.command(output)) == 0
        return (self.home / output).read_bytes()


@pytest.fixture(scope="module")
def finished(demo: DemoSet, tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A run of six of eight rows with two units."""
    room = Room(tmp_path_factory.mktemp("finished"))
    shutil.copytree(demo.test_dir, room.home / "test")
    shutil.copy(room.table, room.home / "rows.csv")
    room.units(FIRST, SECOND)
    room.rows(BEFORE)
    room.run()
    return room


@pytest.fixture
def room(finished: Room, tmp_path: Path) -> Room:
    return Room(shutil.copytree(finished.home, tmp_path / "room"))


def rows_of(room: Room, name: str) -> int:
    return sum(name in row.split(",")[2:] for row in room.table.read_text().splitlines())


def rarest_image(room: Room) -> tuple[str, str]:
    """The batch and the name of the image of the first row that fewest rows have."""
    _, batch, first, second = room.table.read_text().splitlines()[1].split(",")
    return batch, min((first, second), key=lambda name: rows_of(room, name))


def replace_an_image(room: Room) -> None:
    """Turn an image upside down."""
    batch, name = rarest_image(room)
    (path,) = (room.home / "test" / "test_images" / batch).glob(f"{name}.*")
    cv2.imwrite(str(path), np.ascontiguousarray(cv2.imread(str(path))[::-1]))


# A change, and the number of units that run after it
CHANGES: dict[str, tuple[Callable[[Room], None], Callable[[Room], int]]] = {
    "nothing": (lambda room: None, lambda room: 0),
    "a unit added": (
        lambda room: room.units(FIRST, SECOND, SECOND.replace("400", "360")),
        lambda room: BEFORE,
    ),
    "a unit removed": (lambda room: room.units(FIRST), lambda room: 0),
    "a unit of stage 1 before the crop": (
        lambda room: room.units(FIRST, THIRD, SECOND),
        lambda room: 2 * BEFORE,
    ),
    "another threshold": (
        lambda room: room.units(FIRST, SECOND, more="threshold = 1.0"),
        lambda room: 0,
    ),
    # No pair of the demo's street needs a crop: their scales are alike.
    "crops where scales differ": (
        lambda room: room.units(FIRST, SECOND, more='[mkpc]\nwhen = "scale"'),
        lambda room: 0,
    ),
    "another option of the matcher": (
        lambda room: room.units(FIRST, SECOND, more="[matchers.sift]\nratio = 0.75"),
        lambda room: 2 * BEFORE,
    ),
    "rows added": (lambda room: room.rows(8), lambda room: 4),
    "an image replaced": (
        replace_an_image,
        lambda room: 2 * rows_of(room, rarest_image(room)[1]),
    ),
}


# Of the others, test_restore, test_estimates and test_assembly see the keys.
@pytest.mark.parametrize(
    "change",
    [
        "a unit of stage 1 before the crop",
        "crops where scales differ",
        "rows added",
        "an image replaced",
        *(pytest.param(change, marks=pytest.mark.slow) for change in CHANGES),
    ],
)
def test_a_change_runs_only_what_depends_on_it_and_gives_the_bytes_of_a_fresh_run(
    room: Room, change: str, capsys
) -> None:
    make, units = CHANGES[change]
    make(room)
    # Fewer units would be a stale result, more would be wasted hours.
    again = room.run()
    (run,) = re.findall(r"(\d+) units run", capsys.readouterr().out)
    assert int(run) == units(room)
    assert again == room.run("fresh.csv")


@pytest.mark.parametrize("seed", range(4))
def test_a_simulated_run_cut_by_its_limit_at_a_random_moment_and_finished_later_has_all_keys_of_a_fresh_one(
    seed,
):
    rng = np.random.default_rng(seed)
    count = rng.integers(3, 6)
    costs = tuple(rng.uniform(0.2, 2.0, count).tolist())
    crops = (1.0, 0.3)[seed % 2]
    whole = Scenario(
        40, costs, 1, math.inf, warm_up=0, misses=0, batches=2, crop_share=crops, seed=seed
    )
    store = memory_store()
    fresh = simulate(whole)
    # Up to a limit that is too long to cut the run
    share = float(rng.uniform(0.2, 1.2))
    cut = simulate(replace(whole, limit=share * whole.work), store)
    finished = simulate(whole, store)
    assert finished.report.ending is fresh.report.ending is Ending.COMPLETE
    assert finished.keys == fresh.keys
    assert finished.stale == set()
    assert cut.keys != fresh.keys or cut.report.ending is Ending.COMPLETE


@pytest.mark.parametrize("moments", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_a_run_cut_by_its_limit_at_a_random_moment_and_finished_later_has_the_bytes_of_an_undisturbed_one(
    pairs, undisturbed, tmp_path, moments
):
    rng = random.Random(moments)
    for number in range(moments):
        # 36 units take 1.8 s or more: the limit ends the run somewhere in its phases.
        slow = RectifiedMatcher(seconds=0.05)
        run(pairs, THREE_UNITS, slow, tmp_path / str(number), limit=rng.uniform(2.2, 3.8))
        report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / str(number))
        assert report.ending is Ending.COMPLETE
        assert matrices(report) == matrices(undisturbed)
        assert matches_of_units(report) == matches_of_units(undisturbed)


def matches_of_units(report: Results) -> list[list[object]]:
    return report.units[["pair", "unit", "matches"]].to_numpy().tolist()


def failed_units(report: Results) -> list[tuple[int, str]]:
    """The index of the pair and the name of each unit that failed."""
    indices = {pair: index for index, pair in enumerate(report.pairs["pair"])}
    failed = report.units.query("failure != ''")
    return [(indices[pair], unit) for pair, unit in failed[["pair", "unit"]].to_numpy()]


def test_the_next_run_repeats_only_units_that_raised(pairs, undisturbed, tmp_path):
    faulty = FaultyMatcher(fault=lack_an_image, above=100)
    failed = run(pairs, THREE_UNITS, faulty, tmp_path / "work")
    assert failed.ending is Ending.WITH_FAILURES
    assert failed_units(failed) == [(3, unit.name) for unit in THREE_UNITS.units[1:]]
    mended = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert mended.about.units_run == 2
    assert matrices(mended) == matrices(undisturbed)
    assert failed_units(mended) == []


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_ten_kills_after_a_change_leave_the_same_bytes(room: Room, change: str) -> None:
    rng = random.Random(change)
    command = [sys.executable, "-m", "mkpc_kaggle", *room.command("a.csv")]
    make, _ = CHANGES[change]
    make(room)
    # From the imports to the report
    for _ in range(10):
        running = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0.5, 6.0))
        os.kill(running.pid, signal.SIGKILL)
        running.wait()
    assert room.run() == room.run("fresh.csv")
