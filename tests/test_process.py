"""Whatever becomes of a worker's process, and however large its job is, no call blocks and the reason is told."""

import multiprocessing
import os
import queue
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from multiprocessing import resource_tracker, util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty import ScenesBy, choose_scene_for_all_but_the_first, die_as_scene, raise_as_scene

from mkpc_kaggle.engine.jobs import Cause, Failure, Loaded, MatchJob, Phase, SceneJob, SceneResult
from mkpc_kaggle.engine.places import Place
from mkpc_kaggle.engine.process import WORKER_ENVIRONMENT, ProcessWorker
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

ROOT = Path(__file__).resolve().parents[1]
IMAGES = (BatchImage("a", "a", Size(80, 72)), BatchImage("b", "b", Size(80, 72)))
POINTS = np.random.default_rng(1).uniform(0, 70, (50_000, 2)).astype(np.float32)
MATCHES = Matches(POINTS, POINTS, POINTS[:, 0])
LARGE = SceneJob("one", (0,), (BatchPair(*IMAGES, MATCHES, None, {"m": MATCHES}),), SceneConfig())


class Worker:
    """A worker process with the scenes of ``make``, whose answers the test waits for."""

    def __init__(self, make: Callable[[SceneJob], SceneResult] = choose_scene_for_all_but_the_first) -> None:
        self.bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self.worker = ProcessWorker("scene", partial(ScenesBy, make), lambda: self.bell.put(None))

    def next_answer(self) -> Any:
        self.bell.get(timeout=120)
        return self.worker.answer()

    def end(self) -> None:
        """Kill it; neither its thread nor its process is left."""
        self.worker.kill()
        self.worker._thread.join(timeout=120)
        assert not self.worker._thread.is_alive()
        for process in multiprocessing.active_children():
            process.join(timeout=120)
            assert not process.is_alive()


@pytest.fixture
def at_birth(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int], None]], None]:
    """What is done with the id of a process as soon as it is forked."""
    resource_tracker.ensure_running()  # a process, too
    spawn = util.spawnv_passfds

    def set_action(action: Callable[[int], None]) -> None:
        def spawned(*arguments: Any) -> int:
            pid: int = spawn(*arguments)
            action(pid)
            return pid

        monkeypatch.setattr(util, "spawnv_passfds", spawned)

    return set_action


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_dies_or_stops_at_its_birth_blocks_nothing(
    at_birth: Callable[..., None], number: signal.Signals
) -> None:
    at_birth(lambda pid: os.kill(pid, number))
    born = Worker()
    born.worker.start()
    if number is signal.SIGKILL:
        assert born.next_answer() == Failure(Cause.DIED, "signal SIGKILL")
    else:
        assert born.worker.answer() is None
    born.end()


def test_a_start_returns_before_there_is_a_process(at_birth: Callable[..., None]) -> None:
    has_returned = threading.Event()
    at_birth(lambda _: has_returned.wait())
    born = Worker()
    born.worker.start()
    assert born.worker.answer() is None
    has_returned.set()
    assert born.next_answer() == Loaded()
    born.end()


def test_a_large_job_goes_to_a_stopped_process_without_blocking(at_birth: Callable[..., None]) -> None:
    born: list[int] = []
    at_birth(born.append)
    stopped = Worker()
    stopped.worker.start()
    assert stopped.next_answer() == Loaded()
    os.kill(born[0], signal.SIGSTOP)
    stopped.worker.submit(LARGE, 1.0)
    assert stopped.worker.answer() is None
    stopped.end()


@pytest.mark.parametrize(
    ("make", "failure"),
    [
        (die_as_scene, Failure(Cause.DIED, "signal SIGKILL")),
        (raise_as_scene, Failure(Cause.RAISED, "KeyError: 'image 7'")),
        (lambda job: None, Failure(Cause.RAISED, "")),
    ],
)
def test_what_became_of_a_job_is_told_and_nothing_is_printed(
    make: Any, failure: Failure, capfd: pytest.CaptureFixture[str]
) -> None:
    worker = Worker(make)
    worker.worker.start()
    answer = worker.next_answer()
    if answer == Loaded():
        worker.worker.submit(LARGE, 1.0)
        answer = worker.next_answer()
    assert answer.cause is failure.cause
    assert failure.message in answer.message, "what cannot be pickled says so"
    worker.end()
    assert capfd.readouterr() == ("", "")


class Answering:
    """A worker that always has the same answer."""

    def __init__(self, answer: Any) -> None:
        self.answer = lambda: answer
        self.is_killed = False

    def start(self) -> None: ...

    def submit(self, job: Any, seconds: float) -> None: ...

    def kill(self) -> None:
        self.is_killed = True


def test_an_answer_that_is_there_counts_though_its_time_is_over() -> None:
    worker = Answering(SceneResult((), {}))
    place = Place("cpu", lambda: worker, worker, is_loaded=True)
    place.submit(LARGE, 1.0, 10.0, now=0.0)
    assert isinstance(place.poll(now=99.0), SceneResult)
    assert not worker.is_killed


@pytest.mark.parametrize("is_retry", [False, True])
def test_a_place_is_not_closed_for_what_other_workers_were_lost_at(is_retry: bool) -> None:
    place = Place("cpu", lambda: Answering(Failure(Cause.DIED)))
    for now in range(3):
        place.start(now)
        place.is_loaded = True
        place.submit(MatchJob(Phase.DEEPEN, (0,), (), (), 1.0, 1.0, is_retry), 1.0, 1.0, now)
        place.poll(now)
    assert bool(place.closed) is not is_retry


ORPHAN = """
import os, signal, sys
sys.path[:0] = {path!r}
from functools import partial
from faulty import ScenesBy, hang_as_scene
from mkpc_kaggle.engine.process import ProcessWorker
from test_process import LARGE

if __name__ == "__main__":
    answers, told = os.pipe()
    worker = ProcessWorker("scene", partial(ScenesBy, hang_as_scene), lambda: os.write(told, b"."))
    worker.start()
    os.read(answers, 1)
    worker.answer()
    worker.submit(LARGE, 1.0)
    os.read(answers, 1)
"""


def test_a_worker_at_work_ends_with_its_parent_and_prints_nothing(tmp_path: Path) -> None:
    script = tmp_path / "orphan.py"  # a file, since its children import it
    script.write_text(ORPHAN.format(path=[str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "support")]))
    mark, home = tmp_path / "hangs", {**os.environ, "MKPC_TEST_HOME": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, str(script)], env=home, stderr=subprocess.PIPE)
    while not (mark.exists() and mark.read_text()):
        assert parent.poll() is None, parent.stderr
        threading.Event().wait(0.05)
    child = os.pidfd_open(int(mark.read_text()))
    parent.kill()
    assert select.select([child], [], [], 120)[0], "it has ended"
    os.close(child)
    assert parent.communicate()[1] == b""


BLOCKED = """
import multiprocessing, signal
from mkpc_kaggle.engine.process import worker_environment

def tell(pipe):
    pipe.send(signal.pthread_sigmask(signal.SIG_BLOCK, ()))

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    ours, its = context.Pipe()
    process = context.Process(target=tell, args=(its,))
    with worker_environment():
        process.start()
    blocked = ours.recv()
    process.join()
    assert blocked >= {signal.SIGINT, signal.SIGTERM}, blocked
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())
"""


def test_the_first_process_of_a_program_hears_no_ctrl_c_from_its_start(tmp_path: Path) -> None:
    script = tmp_path / "blocked.py"
    script.write_text(BLOCKED)
    subprocess.run([sys.executable, script], timeout=120, check=True)


def tell_environment(path: Path) -> ScenesBy:
    """Write down what the process was started with."""
    entries = Path("/proc/self/environ").read_text().split("\0")
    started_with = dict(entry.split("=", 1) for entry in entries if "=" in entry)
    path.write_text(", ".join(started_with.get(name, "") for name in WORKER_ENVIRONMENT))
    return ScenesBy(choose_scene_for_all_but_the_first)


def test_workers_are_told_not_to_spin_and_to_use_huge_pages_and_nobody_else_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in WORKER_ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    worker = Worker()
    worker.worker._make = partial(tell_environment, tmp_path / "told")
    worker.worker.start()
    assert worker.next_answer() == Loaded()
    worker.end()
    assert (tmp_path / "told").read_text() == "PASSIVE, 7, 1"
    assert {name: os.environ[name] for name in WORKER_ENVIRONMENT if name in os.environ} == {"GOMP_SPINCOUNT": "7"}
