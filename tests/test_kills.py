"""Workers that are killed or stopped at random moments from their fork to their answers cost a run nothing."""

import multiprocessing
import os
import random
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from itertools import cycle
from multiprocessing import resource_tracker, util
from pathlib import Path
from typing import Any, ClassVar

import pytest
from faulty import WatchedWorker, patient
from rectified import run
from synthetic import RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.engine import Ending, RunReport
from mkpc_kaggle.engine.records import GIVEN_UP
from mkpc_kaggle.geometry.robust import RobustConfig

BATCHES = WORKERS = 3  # in a run so many scene workers and so many matching workers are disturbed

QUICK = replace(RECIPE, magsac=RobustConfig(max_iterations=1000, permutations=1))


class DoomedWorker(WatchedWorker):
    """Gets a signal when its process has computed for so long: the machine's other load does not move that moment.

    The moments are drawn from the ``lives``, in seconds, of the workers of an undisturbed run. What comes after a
    disturbed worker is spared, so that no reconstruction is lost twice.
    """

    rng: ClassVar = random.Random(0)
    signals: ClassVar = cycle([signal.SIGKILL, signal.SIGSTOP])
    lives: ClassVar[dict[str, float]] = {}
    spared: ClassVar[set[str]] = set()
    sent: ClassVar[list[tuple[str, signal.Signals, float]]] = []
    known: ClassVar[dict[str, "DoomedWorker"]] = {}

    def __init__(self, name: str, *arguments: Any) -> None:
        super().__init__(f"{name}, {len(self.known)}", *arguments)
        self.known[self.name] = self
        self.place, self.kind = name, name.split(maxsplit=1)[0]
        self.signal: signal.Signals | None = None
        self.clock = 0

    def on_fork(self, pid: int) -> None:
        self.clock = (~pid << 3) | 2  # of the processor time of another process, as clock_getcpuclockid has it
        if self.place in self.spared:
            self.spared.remove(self.place)
        elif self.kind in self.lives:
            moment = self.rng.uniform(0.0, self.lives[self.kind])
            number = next(self.signals)
            threading.Thread(target=self._disturb, args=(os.pidfd_open(pid), number, moment), daemon=True).start()

    def is_stuck(self) -> bool:
        return self.signal is signal.SIGSTOP

    def kill(self) -> None:
        with suppress(OSError):
            self.computed = time.clock_gettime(self.clock)
        super().kill()

    def _disturb(self, process: int, number: signal.Signals, moment: float) -> None:
        with suppress(OSError):  # it has ended before
            while time.clock_gettime(self.clock) < moment:
                time.sleep(0.001)
            self.spared.add(self.place)
            signal.pidfd_send_signal(process, number)
            self.signal = number
            self.sent.append((self.kind, number, moment))
        os.close(process)


@pytest.fixture
def forks(monkeypatch) -> None:
    """Tell workers of their processes as soon as these are forked."""
    for name, empty in {"lives": {}, "spared": set(), "sent": [], "known": {}}.items():
        monkeypatch.setattr(DoomedWorker, name, empty)
    resource_tracker.ensure_running()  # a process, too
    spawn = util.spawnv_passfds

    def spawned(*arguments: Any) -> int:
        pid: int = spawn(*arguments)
        DoomedWorker.known[threading.current_thread().name].on_fork(pid)
        return pid

    monkeypatch.setattr(util, "spawnv_passfds", spawned)


def scene_batches(directory: Path) -> list[Pair]:
    batches = [(name, synthetic_pairs(directory / name)) for name in map(str, range(BATCHES))]
    return [replace(pair, id=f"{name};{pair.id}", group=name) for name, pairs in batches for pair in pairs]


def matrices(report: RunReport, batches: set[str], pairs: list[Pair]) -> list[bytes]:
    rows = zip(pairs, report.records, strict=True)
    return [
        record.pair_fundamental.tobytes() + record.chosen_fundamental.tobytes()
        for pair, record in rows
        if pair.group in batches
    ]


@pytest.mark.parametrize("moments", [6, pytest.param(40, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])])
def test_a_run_whose_workers_are_killed_and_stopped_at_random_moments_ends_as_the_undisturbed_one(
    tmp_path, monkeypatch, forks, moments
):
    pairs = scene_batches(tmp_path / "images")
    budget = patient(monkeypatch, DoomedWorker)

    def run_whole(name: str) -> RunReport:
        report = run(pairs, QUICK, SyntheticMatcher(), tmp_path / name, budget=budget, workers=WORKERS)
        assert report.ending is Ending.COMPLETE, report.faults
        assert all(record.units for record in report.records)
        for process in multiprocessing.active_children():
            process.join(timeout=60)
            assert not process.is_alive()
        return report

    undisturbed = run_whole("undisturbed")
    assert undisturbed.faults == ()
    for worker in DoomedWorker.known.values():
        DoomedWorker.lives[worker.kind] = max(DoomedWorker.lives.get(worker.kind, 0.0), worker.computed)
    compared = 0
    while len(DoomedWorker.sent) < moments:
        report = run_whole(f"disturbed {len(DoomedWorker.sent)}")
        given_up = {
            pair.group
            for pair, record in zip(pairs, report.records, strict=True)
            if any(unit.failure.startswith(GIVEN_UP) for unit in record.units)
        }
        intact = {pair.group for pair in pairs} - given_up
        assert matrices(report, intact, pairs) == matrices(undisturbed, intact, pairs), report.faults
        compared += len(intact)
    assert {number for _, number, _ in DoomedWorker.sent} == {signal.SIGKILL, signal.SIGSTOP}
    assert {kind for kind, _, _ in DoomedWorker.sent} == {"mkpc", "scene"}
    assert compared > 0
