"""Workers that are killed or stopped at random moments from their fork to their answers cost a run
nothing.
"""

import multiprocessing
import os
import random
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from itertools import cycle
from math import inf
from multiprocessing.process import BaseProcess
from typing import Any, ClassVar

import numpy as np
import pytest
from faulty import on_fork
from rectified import run
from simulator import VirtualClock
from synthetic import RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import places, session
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.frames import Results, matrices_of
from mkpc_kaggle.engine.places import LocalSite
from mkpc_kaggle.engine.process import ProcessWorker
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.geometry.robust import RobustConfig

BATCHES = WORKERS = 3  # in a run so many scene workers and so many matching workers are disturbed
SCENE = "scene"  # the name of all workers for scenes, on any place
A_SCENE = "a scene of this run was disturbed"
QUICK = replace(RECIPE, magsac=RobustConfig(max_iterations=1000))


class DoomedWorker(ProcessWorker):
    """Gets a signal when its process has computed for so long: the machine's other load does not
    move that moment.

    The moments are drawn from the ``lives``, in seconds, of the workers of an undisturbed run. No
    reconstruction may be lost twice, since it would be given up. Scenes run on several places, so a
    lost one may be tried again on any of them: of a run's scenes, one is disturbed. On other places
    the process after a disturbed one is spared.
    """

    rng: ClassVar = random.Random(0)
    signals: ClassVar = cycle([signal.SIGKILL, signal.SIGSTOP])
    lives: ClassVar[dict[str, float]] = {}
    spared: ClassVar[set[str]] = set()
    sent: ClassVar[list[tuple[str, signal.Signals]]] = []
    known: ClassVar[dict[str, "DoomedWorker"]] = {}
    choosing: ClassVar = threading.Lock()  # two scenes may reach their moments together

    def __init__(self, name: str, *arguments: Any) -> None:
        super().__init__(f"{name}, {len(self.known)}", *arguments)
        self.known[self.name] = self
        self.place = name
        self.kind = name.split(maxsplit=1)[0]
        self.signal: signal.Signals | None = None
        self.is_busy = False  # from its start to its answer, and from a job to its answer
        self.clock = 0

    def start(self) -> None:
        self.is_busy = True
        super().start()

    def submit(self, job: Any) -> None:
        self.is_busy = True
        super().submit(job)

    def answer(self) -> Any:
        answer = super().answer()
        self.is_busy = self.is_busy and answer is None
        return answer

    def kill(self) -> None:
        self.is_busy = False
        with suppress(OSError):
            self.computed = time.clock_gettime(self.clock)
        super().kill()

    def on_fork(self, pid: int) -> None:
        # Of the processor time of another process, as clock_getcpuclockid has it
        self.clock = (~pid << 3) | 2
        if self.place in self.spared:
            self.spared.remove(self.place)
        elif self.kind in self.lives:
            moment = self.rng.uniform(0.0, self.lives[self.kind])
            # A descriptor, since the number of an ended process may be given to another.
            process = os.pidfd_open(pid)
            disturb = threading.Thread(target=self._disturb, args=(process, moment), daemon=True)
            disturb.start()

    def _disturb(self, process: int, moment: float) -> None:
        try:
            self._send(process, moment)
        finally:
            os.close(process)

    def _send(self, process: int, moment: float) -> None:
        number = next(self.signals)
        with suppress(OSError):  # it has ended before
            while time.clock_gettime(self.clock) < moment:
                time.sleep(0.001)
            with self.choosing:
                if self.kind == SCENE and A_SCENE in self.spared:
                    return
                self.spared.add(A_SCENE if self.kind == SCENE else self.place)
            signal.pidfd_send_signal(process, number)
            self.signal = number
            self.sent.append((self.kind, number))


class PatientSite(LocalSite):
    """Its clock stands still, until nothing else can happen since all that are at work are stopped.

    So no time limit of a worker is over early on a busy machine, and none is waited for.
    """

    def wait(self, until: float) -> None:
        super().wait(until)
        busy = [worker for worker in DoomedWorker.known.values() if worker.is_busy]
        if busy and all(worker.signal is signal.SIGSTOP for worker in busy):
            self._clock.now += 60.0


@pytest.fixture
def forks(monkeypatch) -> None:
    """Tell workers of their processes as soon as these are forked."""
    for name, empty in {"lives": {}, "spared": set(), "sent": [], "known": {}}.items():
        monkeypatch.setattr(DoomedWorker, name, empty)

    def tell_worker(pid: int) -> None:
        DoomedWorker.known[threading.current_thread().name].on_fork(pid)

    on_fork(monkeypatch, tell_worker)


def matrices(report: Results, batches: set[str], pairs: list[Pair]) -> list[bytes]:
    own = report.pairs["own"]
    rows = zip(pairs, own, matrices_of(report.pairs), strict=True)
    return [
        np.array(own, float).tobytes() + written.tobytes()
        for pair, own, written in rows
        if pair.group in batches
    ]


def has_ended(process: BaseProcess, within_s: float = 60.0) -> bool:
    until = time.monotonic() + within_s
    # The worker's thread waits for it, too. Of two threads that wait, the system tells one of the
    # end, and for a moment the other takes the process for alive.
    while process.is_alive() and time.monotonic() < until:
        process.join(timeout=0.1)
    return not process.is_alive()


@pytest.mark.parametrize(
    "moments", [6, pytest.param(40, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
)
def test_a_run_whose_workers_are_killed_and_stopped_at_random_moments_ends_as_the_undisturbed_one(
    tmp_path, monkeypatch, forks, moments
):
    pairs = []
    for batch in range(BATCHES):
        folder = tmp_path / "images" / str(batch)
        pairs += synthetic_pairs(folder, batch=str(batch))
    budget = Budget(0.0, inf, VirtualClock())
    monkeypatch.setattr(places, "ProcessWorker", DoomedWorker)
    monkeypatch.setattr("mkpc_kaggle.engine.run.RESTART_PAUSE_S", 0.0)
    monkeypatch.setattr(session, "LocalSite", PatientSite)

    def run_whole(name: str) -> Results:
        DoomedWorker.spared.discard(A_SCENE)
        report = run(
            pairs, QUICK, SyntheticMatcher(), tmp_path / name, budget=budget, workers=WORKERS
        )
        assert report.ending is Ending.COMPLETE, report.about.faults
        assert report.pairs["units"].all()
        # Neither a stopped process nor one that was just started may stay behind.
        for process in multiprocessing.active_children():
            assert has_ended(process), process
        return report

    undisturbed = run_whole("undisturbed")
    assert undisturbed.about.faults == []
    # Later moments are drawn from the whole life of a worker, its start and its end included.
    for worker in DoomedWorker.known.values():
        longest = DoomedWorker.lives.get(worker.kind, 0.0)
        DoomedWorker.lives[worker.kind] = max(longest, worker.computed)
    compared = 0
    while len(DoomedWorker.sent) < moments:
        report = run_whole(f"disturbed {len(DoomedWorker.sent)}")
        # A pair whose unit was lost twice may differ.
        lost = report.units.query("failure != ''")["pair"]
        given_up = {pair.group for pair in pairs if pair.id in set(lost)}
        intact = {pair.group for pair in pairs} - given_up
        assert matrices(report, intact, pairs) == matrices(undisturbed, intact, pairs), (
            report.about.faults
        )
        compared += len(intact)
    # Otherwise some kind of worker, or one of the signals, was not tested.
    assert {number for _, number in DoomedWorker.sent} == {signal.SIGKILL, signal.SIGSTOP}
    assert {kind for kind, _ in DoomedWorker.sent} == {"mkpc", "estimates", SCENE}
    assert compared > 0
