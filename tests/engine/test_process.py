"""Calls of a worker never block, whatever happens to its process, and report why it was lost."""

import multiprocessing
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty import choose_scene_for_all_but_the_first, on_fork, runner

from mkpc_kaggle.cores import WORKER_ENVIRONMENT
from mkpc_kaggle.engine.process import ProcessWorker
from mkpc_kaggle.engine.request import Cause, Failure, Loaded, SceneJob
from mkpc_kaggle.engine.store import Source
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

ROOT = Path(__file__).resolve().parents[2]
IMAGES = (
    BatchImage("a", "a", Size(80, 72)),
    BatchImage("b", "b", Size(80, 72)),
)
# A megabyte, and a pipe holds 64 kB: a write to a process that does not read would block.
POINTS = np.random.default_rng(1).uniform(0, 70, (50_000, 2)).astype(np.float32)
MATCHES = Matches(POINTS, POINTS, POINTS[:, 0])
SCENES = Recipe((Unit(1, "m", 80),), scene=SceneConfig())
LARGE = SceneJob((BatchPair(*IMAGES, (MATCHES,)),), SCENES, Source(), (0, 0), "one", "", "k")


class Worker(ProcessWorker):
    """A worker process with the scenes of ``make``, whose answers the test waits for."""

    def __init__(self, make: Callable[[SceneJob], Solution]) -> None:
        self._bell = threading.Semaphore(0)
        super().__init__("scene", partial(runner, make), self._bell.release)

    def next_answer(self) -> Any:
        assert self._bell.acquire(timeout=120)
        return self.answer()


@pytest.fixture
def start() -> Iterator[Callable[..., Worker]]:
    """Starts a worker. In the end it is killed, and neither its thread nor its process is left."""
    workers = []

    def start(
        make: Callable[[SceneJob], Solution] = choose_scene_for_all_but_the_first,
    ) -> Worker:
        workers.append(Worker(make))
        workers[-1].start()
        return workers[-1]

    yield start
    for worker in workers:
        worker.kill()
        worker.thread.join(timeout=120)
        assert not worker.thread.is_alive()
    for process in multiprocessing.active_children():
        process.join(timeout=120)
        assert not process.is_alive()


def test_a_worker_that_cannot_be_sent_to_its_process_says_so(start):
    # A lambda cannot be pickled.
    assert start(lambda job: None).next_answer().cause is Cause.RAISED


def test_a_process_that_dies_at_its_start_is_reported(monkeypatch, start):
    # As the system does if memory is short
    on_fork(monkeypatch, lambda pid: os.kill(pid, signal.SIGKILL))
    assert start().next_answer() == Failure(Cause.DIED, "signal SIGKILL")


def test_a_large_job_goes_to_a_stopped_process_without_blocking(monkeypatch, start):
    born: list[int] = []
    on_fork(monkeypatch, born.append)
    worker = start()
    assert worker.next_answer() == Loaded()
    os.kill(born[0], signal.SIGSTOP)
    worker.submit(LARGE)
    assert worker.answer() is None


ORPHAN = """
import os, signal, sys
sys.path[:0] = {path!r}
from functools import partial
from faulty import befall, hang, runner
from mkpc_kaggle.engine.process import ProcessWorker
from test_process import LARGE

if __name__ == "__main__":
    answers, told = os.pipe()
    worker = ProcessWorker("scene", partial(runner, partial(befall, hang)), lambda: os.write(told, b"."))
    worker.start()
    os.read(answers, 1)
    worker.answer()
    worker.submit(LARGE)
    os.read(answers, 1)
"""


@pytest.mark.parametrize("is_stopped", [False, True])
def test_a_worker_at_work_ends_with_its_parent_and_prints_nothing(tmp_path, is_stopped):
    script = tmp_path / "orphan.py"  # a file, since its children import it
    paths = [str(ROOT), str(Path(__file__).parent), str(ROOT / "tests" / "support")]
    script.write_text(ORPHAN.format(path=paths))
    # The worker writes its process's number there before it hangs.
    mark = tmp_path / "hangs"
    home = {**os.environ, "MKPC_TEST_HOME": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, str(script)], env=home, stderr=subprocess.PIPE)
    while not (mark.exists() and mark.read_text()):
        assert parent.poll() is None, parent.stderr
        threading.Event().wait(0.05)
    child = os.pidfd_open(int(mark.read_text()))
    # A stopped process reads no end of file, so only the system can end it with its parent.
    if is_stopped:
        signal.pidfd_send_signal(child, signal.SIGSTOP)
    parent.kill()
    assert select.select([child], [], [], 120)[0], "it has ended"
    os.close(child)
    assert parent.communicate()[1] == b""


# In a file that the worker can import: the program itself is not imported there.
CHECKS = """
import signal
from pathlib import Path
from mkpc_kaggle.cores import WORKER_ENVIRONMENT

def check():
    entries = Path("/proc/self/environ").read_text().split(chr(0))
    told = dict(entry.split("=", 1) for entry in entries if "=" in entry)
    assert [told[name] for name in WORKER_ENVIRONMENT] == ["PASSIVE", "7", "1"], told
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert blocked >= {signal.SIGINT, signal.SIGTERM}, blocked
"""
STARTS = """
import os, signal, threading
from checks import check
from mkpc_kaggle.engine.request import Loaded
from mkpc_kaggle.cores import WORKER_ENVIRONMENT
from mkpc_kaggle.engine.process import ProcessWorker

answers = threading.Semaphore(0)
worker = ProcessWorker("scene", check, answers.release)
worker.start()
answers.acquire()
assert worker.answer() == Loaded()
worker.kill()
assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())
assert [name for name in WORKER_ENVIRONMENT if name in os.environ] == ["GOMP_SPINCOUNT"]
"""


def test_the_first_worker_of_a_program_hears_no_ctrl_c_and_is_told_not_to_spin_and_to_use_huge_pages(
    tmp_path,
):
    script = tmp_path / "starts.py"
    (tmp_path / "checks.py").write_text(CHECKS)
    script.write_text(STARTS)
    environment = dict(os.environ)
    for name in WORKER_ENVIRONMENT:
        environment.pop(name, None)
    # A value that the user has set stays.
    environment |= {"GOMP_SPINCOUNT": "7", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, script], env=environment, check=True)
