"""Whatever becomes of a scene's process, and however large its job is, the engine does not wait for it."""

import os
import signal
import threading
from multiprocessing import resource_tracker, util
from multiprocessing.context import SpawnProcess

import numpy as np
import pytest

from mkpc_kaggle.engine.pools import scene_process
from mkpc_kaggle.engine.pools.scene_process import SceneProcess
from mkpc_kaggle.engine.scenes import SceneJob
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.batch import BatchPair
from mkpc_kaggle.scene.config import SceneConfig

POINTS = np.random.default_rng(1).uniform(0, 500, (50_000, 2)).astype(np.float32)
MATCHES = Matches(POINTS, POINTS, POINTS[:, 0])
LARGE = SceneJob("one", (0,), (BatchPair("a", "b", MATCHES, None, {"m": MATCHES}),), SceneConfig())


def start(seconds: float = 60.0) -> SceneProcess | None:
    """The process, started in another thread; ``None`` where its start blocks."""
    started: list[SceneProcess] = []
    thread = threading.Thread(target=lambda: started.append(SceneProcess(LARGE)), daemon=True)
    thread.start()
    thread.join(seconds)
    return started[0] if started else None


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_dies_or_stops_at_its_birth_blocks_nothing(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    resource_tracker.ensure_running()  # a process, too
    spawn = util.spawnv_passfds

    def stillborn(*arguments: object) -> int:
        pid: int = spawn(*arguments)
        os.kill(pid, number)
        return pid

    monkeypatch.setattr(util, "spawnv_passfds", stillborn)
    process = start()
    assert process is not None
    if number is signal.SIGSTOP:
        assert process.answer() is None
    process.kill()
    while process.answer() is None:
        threading.Event().wait(0.05)
    assert "its process ended: signal SIGKILL" in str(process.answer())


def test_a_process_that_cannot_be_started_is_a_failure_of_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(_: SpawnProcess) -> None:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(scene_process.SpawnProcess, "start", no_memory)
    process = SceneProcess(LARGE)
    assert "cannot be started: [Errno 12] Cannot allocate memory" in str(process.answer())
    process.kill()
