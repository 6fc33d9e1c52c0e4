"""Tasks before there are pairs: kept as they come, tried again when a worker is lost, ended by an interrupt."""

import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path

from mkpc_kaggle.engine import places
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.engine.tasks import run_tasks

Do = Callable[[], bytes]


def logged(log: Path, answer: bytes) -> bytes:
    with log.open("ab") as stream:
        stream.write(answer + b"\n")
    return answer


def killed_once(mark: Path) -> bytes:
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return b"at last"


def killed() -> bytes:
    os.kill(os.getpid(), signal.SIGKILL)
    return b""


def failing() -> bytes:
    raise RuntimeError("CUDA error: an illegal memory access was encountered")


def never_done(mark: Path) -> bytes:
    mark.touch()
    time.sleep(1000)
    return b""


def run(directory: Path, tasks: dict[str, Do], interrupt: Interrupt | None = None, limit: float = inf) -> bool:
    session = Session(directory, Budget(time.monotonic(), limit), interrupt or Interrupt(), progress=False)
    with Journal(directory, {}) as journal:
        return run_tasks("look", tasks, journal, session)


def answers(directory: Path, *keys: str) -> list[bytes]:
    with Journal(directory, {}) as journal:
        return [journal.task(key) for key in keys]


def test_answers_are_kept_and_not_asked_for_again(tmp_path):
    tasks: dict[str, Do] = {key: partial(logged, tmp_path / "log", key.encode()) for key in "abc"}
    assert run(tmp_path / "work", {key: tasks[key] for key in "ab"})
    assert run(tmp_path / "work", tasks)
    assert sorted((tmp_path / "log").read_bytes().split()) == [b"a", b"b", b"c"]
    assert answers(tmp_path / "work", *"abc") == [b"a", b"b", b"c"]


def test_a_task_whose_worker_dies_is_tried_again_and_what_fails_costs_itself_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(places, "RESTART_PAUSE_S", 0.0)
    tasks: dict[str, Do] = {
        **{f"killed {number}": killed for number in range(4)},
        "killed once": partial(killed_once, tmp_path / "mark"),
        "failing": failing,
        "good": partial(logged, tmp_path / "log", b"good"),
    }
    assert run(tmp_path / "work", tasks)
    assert answers(tmp_path / "work", "killed once", "failing", "good") == [b"at last", b"", b"good"]
    said = capsys.readouterr().err
    assert said.count("failed: the worker died: signal SIGKILL") == 4
    assert "look: failing failed: the device failed: RuntimeError: CUDA error" in said


def test_an_interrupt_ends_tasks_that_are_never_done(tmp_path):
    interrupt, mark = Interrupt(), tmp_path / "mark"

    def interrupt_it() -> None:
        while not mark.exists():
            time.sleep(0.01)
        interrupt.set()

    threading.Thread(target=interrupt_it, daemon=True).start()
    assert not run(tmp_path / "work", {"never": partial(never_done, mark)}, interrupt)
    assert answers(tmp_path / "work", "never") == [b""]


def test_the_limit_ends_tasks_that_are_never_done(tmp_path):
    assert not run(tmp_path / "work", {"never": partial(never_done, tmp_path / "mark")}, limit=3.0)
