"""Faults injected into real runs: a worker, an image, a disk, a terminal or a parent that is lost."""

import os
import pty
import random
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from faulty import FaultyMatcher, exhaust_memory
from processes import started_with
from rectified import THREE_UNITS, RectifiedMatcher, matrices, run, write_pairs
from run_tables import matrices_of
from shared import write_small_recipe

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import read_test_side, submission_problem
from mkpc_kaggle.data.images import Unreadable
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine import keys, session, worker
from mkpc_kaggle.engine.frames import results, results_of
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.signals import interruptible

ROOT = Path(__file__).resolve().parents[2]


PATHS = [str(ROOT), str(ROOT / "tests" / "support")]


def test_worker_processes_give_the_bytes_of_a_run_in_this_process_and_estimate_f_themselves(
    pairs, undisturbed, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        worker, "with_estimate", lambda *_: pytest.fail("F is estimated in the parent")
    )
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", workers=2)
    assert report.ending is Ending.COMPLETE
    assert report.about.faults == []
    assert matrices(report) == matrices(undisturbed)


def test_a_worker_without_memory_once_costs_time_alone(pairs, undisturbed, tmp_path):
    matcher = FaultyMatcher(fault=exhaust_memory, once=tmp_path / "once")
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=1)
    assert report.ending is Ending.COMPLETE
    (fault,) = report.about.faults
    assert "out of memory: MemoryError: Unable to allocate 2.00 GiB" in fault
    assert matrices(report) == matrices(undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_resumed_run_while_an_image_is_digested(
    tmp_path, monkeypatch, number
):
    pairs = write_pairs(tmp_path / "images", 12)
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    first = iter([number])
    released = threading.Event()
    digested = []

    def digest(path: Path) -> Unreadable:
        for signal_number in first:
            os.kill(os.getpid(), signal_number)
            # As long as the digest of an image of many GB takes
            released.wait(60)
            digested.append(path)
        return Unreadable(str(path), "changed")

    monkeypatch.setattr(keys, "image_facts", digest)
    # Copied or restored files have other times: whether they changed, only a digest can tell.
    for path in (tmp_path / "images").iterdir():
        os.utime(path, (0, 0))
    with interruptible() as interrupt:
        report = run(
            pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", interrupt=interrupt
        )
    assert digested == [], "the run ends before that digest"
    released.set()
    assert (report.ending, interrupt.signal) == (Ending.INTERRUPTED, number)


def test_an_error_of_the_engine_itself_leaves_the_latest_version_behind(
    pairs, tmp_path, monkeypatch
):
    save = Run._save_points
    saved = []
    published = []

    def fail_later(self: Run, *arguments: Any) -> None:
        saved.append(self)
        if len(saved) > 2:
            raise KeyError("a bug")
        save(self, *arguments)

    monkeypatch.setattr(Run, "_save_points", fail_later)
    with pytest.raises(KeyError, match="a bug"):
        run(
            pairs,
            THREE_UNITS,
            RectifiedMatcher(),
            tmp_path / "work",
            publish=published.append,
        )
    assert len(published[-1].written[1]) == 12
    with Store.read(tmp_path / "work") as store:
        has_units = results_of(store).pairs["units"] > 0
    assert has_units.tolist() == [True, True] + [False] * 10


def test_a_run_whose_store_is_full_keeps_its_results_in_memory(
    pairs, undisturbed, tmp_path, monkeypatch
):
    # SQLite then reports a full disk after a few results.
    monkeypatch.setattr(Store, "open", partial(small_store, 40))
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert any("is full" in fault for fault in report.about.faults)
    assert matrices(report) == matrices(undisturbed)
    # Later there is room: what was not written is computed again.
    monkeypatch.undo()
    resumed = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert resumed.ending is Ending.COMPLETE
    assert matrices(resumed) == matrices(undisturbed)


def test_a_submission_that_the_disk_refuses_is_reported_and_the_exit_status_is_one(
    demo, small_recipe, tmp_path, monkeypatch, capsys
):
    whole = session.write_submission
    versions = []

    def full(path: Path, rows: dict[str, Any]) -> None:
        versions.append(rows)
        # The disk fills up after the first version.
        if len(versions) > 1:
            raise OSError(28, "No space left on device")
        whole(path, rows)

    monkeypatch.setattr(session, "write_submission", full)
    output = tmp_path / "submission.csv"
    assert main(["submit", *arguments_of(demo, small_recipe, output), "--workers", "0"]) == 1
    assert "is not the last version" in capsys.readouterr().out
    assert (
        submission_problem(output, [pair.id for pair in read_test_side(demo.test_dir)]) == ""
    )


def arguments_of(demo: DemoSet, recipe: Path, output: Path) -> list[str]:
    return [
        "--test-dir",
        str(demo.test_dir),
        "--no-report",
        "--output",
        str(output),
        "--recipe",
        str(recipe),
    ]


def on_a_terminal(command: list[str], *, is_stopped: bool = False) -> int:
    """On a terminal that is stopped, as after Ctrl-S, or that goes away."""
    ours, its = pty.openpty()
    # From now on each write to the terminal blocks.
    if is_stopped:
        termios.tcflow(its, termios.TCOOFF)
    running = subprocess.Popen(
        command, stdin=its, stdout=its, stderr=its, start_new_session=True
    )
    os.close(its)
    if is_stopped:
        running.wait()
    os.close(ours)
    return running.wait()


CANNOT_PRINT = {  # tests/hostile/unread.py has pipes that are full
    "closed terminal": on_a_terminal,
    "stopped terminal": partial(on_a_terminal, is_stopped=True),
}


@pytest.fixture(scope="module")
def told(demo: DemoSet, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The submission of a run in this process, which can print."""
    home = tmp_path_factory.mktemp("told")
    arguments = arguments_of(demo, write_small_recipe(home), home / "told.csv")
    assert main(["submit", *arguments, "--workers", "0"]) == 0
    return (home / "told.csv").read_bytes()


@pytest.mark.parametrize("run_without", CANNOT_PRINT.values(), ids=CANNOT_PRINT)
def test_a_run_that_cannot_print_makes_the_whole_submission(
    demo, small_recipe, told, tmp_path, monkeypatch, run_without
):
    # Each write then reaches the stream at once, and fails or blocks there.
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    script = [sys.executable, str(ROOT / "make_submission.py")]
    output = tmp_path / "alone.csv"
    assert run_without([*script, *arguments_of(demo, small_recipe, output)]) == 0
    assert output.read_bytes() == told


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


STUCK = """
import sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.places import LocalSite
from mkpc_kaggle.engine.state import State

budget = Budget(time.monotonic(), 1000.0)
wait, use, saved = LocalSite.wait, State.use_estimate, []
def noted(self, *estimate):
    use(self, *estimate)
    saved.append(estimate)
def stuck(self, until):
    if len(saved) < 2:
        return wait(self, until)
    budget.time_limit = (budget.clock() - budget.started) + 1
    time.sleep(1000)
State.use_estimate, LocalSite.wait = noted, stuck
home = Path(sys.argv[1])
pairs = write_pairs(home / "pairs", 40)
def publish(state):
    (home / "out").write_text(str(len(set(map(bytes, state.written[1])))))
run(pairs, THREE_UNITS, RectifiedMatcher(), home / "work", budget=budget, publish=publish, is_watched=True)
"""


def test_the_watchdog_writes_the_file_and_exits_if_the_engine_hangs(tmp_path):
    assert python(STUCK.format(path=PATHS), str(tmp_path)).returncode == 0
    assert int((tmp_path / "out").read_text()) > 1


KILLED = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs

if __name__ == "__main__":
    home = Path(sys.argv[1])
    pairs, matcher = write_pairs(home / "pairs", 12), RectifiedMatcher(seconds=0.02)
    run(pairs, THREE_UNITS, matcher, home / "work", workers=1, output=home / "submission.csv")
"""


@pytest.mark.parametrize(
    "moments", [1, pytest.param(20, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
)
def test_a_parent_killed_at_any_moment_leaves_a_complete_file_no_orphans_and_a_resumable_run(
    pairs, undisturbed, tmp_path, moments
):
    script = tmp_path / "run.py"
    script.write_text(KILLED.format(path=PATHS))
    mark = f"MKPC_TEST={tmp_path}"
    rng = random.Random(0)  # the first moment is in the middle
    environment = {**os.environ, "MKPC_TEST": str(tmp_path)}
    for _ in range(moments):
        running = subprocess.Popen(
            [sys.executable, str(script), str(tmp_path)], env=environment
        )
        # From the imports to the last pair
        time.sleep(rng.uniform(0.5, 5.0))
        running.send_signal(signal.SIGKILL)
        running.wait()
        submission = tmp_path / "submission.csv"
        if submission.exists():
            assert submission_problem(submission, [pair.id for pair in pairs]) == ""
        # Its workers notice that soon, even in the middle of a job.
        while started_with(mark):
            time.sleep(0.05)
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True)
    # A process that was killed cannot remove its unfinished file; the next one does.
    assert list(tmp_path.glob(".*.part")) == []
    written = matrices_of(results(tmp_path / "work").pairs)
    assert written.tolist() == matrices_of(undisturbed.pairs).tolist()


GUARDED = """
import multiprocessing, os, signal, sys, time
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session
from mkpc_kaggle.signals import Interrupt

if __name__ == "__main__":
    with Session("", Budget(time.monotonic(), {limit}), Interrupt()).watched() as session:
        {body}
"""


def stuck(body: str) -> subprocess.CompletedProcess[str]:
    """Run the code below a watchdog, then hang half a second before the limit."""
    body += "; session.budget.time_limit = (time.monotonic() - session.budget.started) + 0.5; time.sleep(600)"
    return python(GUARDED.format(limit=1000.0, body=body))


def test_a_child_that_was_stopped_does_not_outlive_the_watchdog():
    fork = "multiprocessing.get_context('fork')"
    statements = [
        f"child = {fork}.Process(target=time.sleep, args=[600], daemon=True)",
        "child.start()",
        "os.kill(child.pid, signal.SIGSTOP)",
        "print(child.pid, flush=True)",
    ]
    done = stuck("; ".join(statements))
    assert done.returncode == 1, "nothing was written"
    assert "the time limit passed before the first results were written" in done.stderr
    status = Path(f"/proc/{done.stdout.strip()}/stat")
    # A zombie is dead; its new parent has not asked for its status yet.
    while status.exists() and status.read_text().split()[2] != "Z":
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("session.save = lambda: time.sleep(600) or ''", 1),
        ("session.save = lambda: ''; session.status = 1", 1),
        ("session.save = lambda: ''", 0),
    ],
)
def test_the_watchdog_exits_even_if_writing_hangs_with_the_status_of_the_run(body, status):
    assert stuck(body).returncode == status


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_the_parent_program_ignores_is_ignored(number):
    # A shell lets its background jobs ignore Ctrl-C.
    code = (
        "import os, signal; from mkpc_kaggle.signals import interruptible\n"
        "with interruptible() as interrupt:\n"
        f"    os.kill(os.getpid(), {int(number)})\n"
        "    print(interrupt.is_set())"
    )
    for action, told in ((signal.SIG_IGN, "False\n"), (signal.SIG_DFL, "True\n")):
        done = subprocess.run(
            [sys.executable, "-c", code],
            preexec_fn=partial(signal.signal, number, action),
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, told, "")


def test_a_full_disk_for_the_journal_alone_is_exit_status_one(
    demo, small_recipe, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(Store, "open", partial(small_store, 6))
    output = tmp_path / "submission.csv"
    assert main(["submit", *arguments_of(demo, small_recipe, output), "--workers", "0"]) == 1
    said = capsys.readouterr().out
    assert "the journal cannot be written (database or disk is full)" in said
    assert (
        submission_problem(output, [pair.id for pair in read_test_side(demo.test_dir)]) == ""
    )


def small_store(
    pages: int,
    directory: Path,
    *,
    opened: Callable[..., Store] = Store.open,
    fresh: bool = False,
) -> Store:
    """Open a store whose file cannot grow beyond its present size and these pages."""
    store = opened(directory, fresh=fresh)
    store.db.execute(f"PRAGMA main.max_page_count = {pages}")
    return store
