"""Faults injected into real runs, on real images, with worker processes."""

import os
import pickle
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from faulty import (
    FaultyMatcher,
    NonsenseMatcher,
    SlowingMatcher,
    VanishingMatcher,
    die,
    exhaust_gpu,
    exhaust_memory,
    hang,
    pipeline_once,
)
from mkpc_kaggle.engine.pools.pool import Pool
from mkpc_kaggle.engine.pools.process import ProcessWorker
from rectified import (
    SWEEP,
    THREE_UNITS,
    RectifiedMatcher,
    interrupt_after,
    process_place,
    run,
    write_pairs,
)

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import Pair, read_test_side, submission_problems
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.engine import session
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.engine.engine import Ending, RunReport
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure, Phase
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.records import NOT_REACHED, PairRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly

ROOT = Path(__file__).resolve().parents[1]
COUNT = 12
VICTIM = 3  # brightness 13
QUICK = Timeouts(floor=0.7, factor=20, unknown=0.0)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    return write_pairs(tmp_path_factory.mktemp("pairs"), COUNT)


@pytest.fixture(scope="module")
def undisturbed(pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    return run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path_factory.mktemp("undisturbed"))


def matrices(records: tuple[PairRecord, ...] | list[PairRecord]) -> list[bytes]:
    return [record.pair_fundamental.tobytes() for record in records]


def assert_others_as_good(report: RunReport, undisturbed: RunReport) -> None:
    assert [record.index for record in report.records] == list(range(COUNT))
    assert all(
        np.isfinite(record.pair_fundamental).all() and record.pair_fundamental.any() for record in report.records
    )
    others = [matrix for index, matrix in enumerate(matrices(report.records)) if index != VICTIM]
    assert others == [matrix for index, matrix in enumerate(matrices(undisturbed.records)) if index != VICTIM]


@pytest.mark.parametrize("workers", [1, 2])
def test_worker_processes_give_the_bytes_of_a_run_in_one_process(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, workers: int
) -> None:
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", workers=workers)
    assert report.ending is Ending.COMPLETE
    assert report.faults == ()
    assert matrices(report.records) == matrices(undisturbed.records)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (die, "the worker died: signal SIGKILL"),
        (hang, "the worker hung: nothing heard for"),
        (exhaust_memory, "out of memory: MemoryError: Unable to allocate 2.00 GiB"),
        (
            exhaust_gpu,
            "out of memory: RuntimeError: CUDA out of memory. Tried to allocate 20.00 GiB, in 1:rectified@96",
        ),
    ],
)
def test_a_worker_lost_once_costs_time_alone(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, fault: object, told: str
) -> None:
    matcher = FaultyMatcher(fault=fault, once=tmp_path / "once")  # type: ignore[arg-type]
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=1, timeouts=QUICK)
    assert report.ending is Ending.COMPLETE
    assert len(report.faults) == 1
    assert told in report.faults[0]
    assert matrices(report.records) == matrices(undisturbed.records)


def test_an_image_that_always_kills_the_worker_costs_its_pair_only_and_once(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    report = run(pairs, THREE_UNITS, FaultyMatcher(), tmp_path / "work", workers=1)
    assert_others_as_good(report, undisturbed)
    assert report.records[VICTIM].failure == "given up: the worker died: signal SIGKILL"
    assert any("pair 3 is left alone after 4 lost jobs" in one.text for one in report.explanations)
    assert report.ending is Ending.COMPLETE
    again = run(pairs, THREE_UNITS, FaultyMatcher(), tmp_path / "work", workers=1)
    assert again.faults == ()
    assert matrices(again.records) == matrices(report.records)


def test_a_pair_that_kills_workers_late_keeps_the_f_it_has(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    report = run(pairs, THREE_UNITS, FaultyMatcher(above=60), tmp_path / "work", workers=1)
    assert_others_as_good(report, undisturbed)
    victim = report.records[VICTIM]
    assert victim.failure.startswith("given up") or victim.inliers > 100


def test_nonsense_from_a_matcher_is_dropped(pairs: list[Pair], undisturbed: RunReport, tmp_path: Path) -> None:
    report = run(pairs, THREE_UNITS, NonsenseMatcher(), tmp_path / "work", workers=1)
    assert matrices(report.records[::2]) == matrices(undisturbed.records[::2])
    assert all("too few" in record.failure for record in report.records[1::2])


def test_an_image_that_vanishes_before_it_is_reached_costs_its_pair_only(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path, 40)
    matcher = VanishingMatcher(victim=pairs[39].image1)
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", workers=1)
    assert "no such file" in report.records[39].failure
    assert all(record.inliers > 400 for record in report.records[:39])


def test_an_image_that_vanishes_after_the_sweep_leaves_its_pair_the_f_it_has(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path, 4)
    only_sweep = run(pairs, THREE_UNITS, RectifiedMatcher(seconds=0.1), tmp_path / "work", limit=2.2)
    reached = [record.index for record in only_sweep.records if len(record.units) == 1]
    assert reached, "the run was to end amid its work"
    victim = reached[0]
    pairs[victim].image1.unlink()
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert report.records[victim].F.tobytes() == only_sweep.records[victim].F.tobytes()
    assert any(f"pair {victim} keeps the F it has" in one.text for one in report.explanations)
    assert all(len(record.units) == 3 for record in report.records if record.index != victim)
    assert report.ending is Ending.COMPLETE


def test_a_run_whose_journal_is_full_keeps_its_results_in_memory(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Journal.__init__

    def small(self: Journal, *rest: object, **more: object) -> None:
        make(self, *rest, **more)  # type: ignore[arg-type]
        self._db.execute("PRAGMA max_page_count = 14")

    monkeypatch.setattr(Journal, "__init__", small)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert any("disk is full" in fault for fault in report.faults)
    assert matrices(report.records) == matrices(undisturbed.records)
    monkeypatch.undo()
    resumed = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert resumed.ending is Ending.COMPLETE
    assert matrices(resumed.records) == matrices(undisturbed.records)


def test_a_submission_that_the_disk_does_not_take_is_told_and_the_exit_status_is_one(
    demo: DemoSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mkpc_kaggle.engine import submit

    whole, versions = submit.write_submission, []

    def full(path: Path, rows: dict[str, np.ndarray]) -> None:
        versions.append(rows)
        if len(versions) > 1:
            raise OSError(28, "No space left on device")
        whole(path, rows)

    monkeypatch.setattr(submit, "write_submission", full)
    recipe, output = tmp_path / "r.toml", tmp_path / "submission.csv"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 200 }]')
    told = ["submit", "--test-dir", str(demo.test_dir), "--output", str(output), "--recipe", str(recipe)]
    assert main([*told, "--workers", "0"]) == 1
    assert "is not the last version" in capsys.readouterr().out
    assert submission_problems(output, [pair.id for pair in read_test_side(demo.test_dir)]) == []


def test_a_wall_clock_that_jumps_moves_no_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = iter(range(0, 10**9, 10**5))
    monkeypatch.setattr(time, "time", lambda: float(next(jumps)))
    started = time.monotonic()
    matcher = RectifiedMatcher(seconds=0.05)
    report = run(write_pairs(tmp_path, 60), THREE_UNITS, matcher, tmp_path / "work", limit=3.0)
    assert 1.2 < time.monotonic() - started < 3.0
    assert report.ending is Ending.TIME_IS_UP
    assert report.records[-1].failure != NOT_REACHED or report.records[0].units


def test_a_worker_ten_times_slower_from_half_way_on_still_ends_in_time(tmp_path: Path) -> None:
    import torch  # noqa: F401  # it takes seconds, before the run's clock starts

    pairs = write_pairs(tmp_path, 60)
    started = time.monotonic()
    matcher = SlowingMatcher(seconds=0.005, turn=90)
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", limit=6.0)
    assert time.monotonic() - started < 6.0
    assert all(record.units for record in report.records)
    assert any("units fit" in one.text for one in report.explanations)
    assert time.monotonic() - started > 3.0, "the time is used"


BLOCKED = """
import multiprocessing, signal
from mkpc_kaggle.engine.pools.spawn import signals_blocked

def tell(pipe):
    pipe.send(signal.pthread_sigmask(signal.SIG_BLOCK, ()))

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    ours, its = context.Pipe()
    process = context.Process(target=tell, args=(its,))
    with signals_blocked():
        process.start()
    blocked = ours.recv()
    process.join()
    assert blocked >= {signal.SIGINT, signal.SIGTERM}, blocked
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())
"""


def test_the_first_process_of_a_program_hears_no_ctrl_c_from_its_start(tmp_path: Path) -> None:
    script = tmp_path / "blocked.py"  # a file, since its children import it
    script.write_text(BLOCKED)
    subprocess.run([sys.executable, script], timeout=60, check=True)


WATCHED = """
import sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from rectified import THREE_UNITS, RectifiedMatcher, write_pairs
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session, Watchdog, run_pairs
from mkpc_kaggle.engine.pools.pool import Pool

taken = Pool.next
def stuck(self, until):
    back = taken(self, until + 5)
    if time.monotonic() > started + 1:
        time.sleep(1000)
    return back
Pool.next = stuck
home = Path(sys.argv[1])
assembly = assemble(THREE_UNITS, matchers={{"rectified": RectifiedMatcher(seconds=0.05)}}, device="cpu")
pairs = write_pairs(home / "pairs", 40)
started = time.monotonic()
budget, interrupt = Budget(started, 3.0), Interrupt()
def publish(records):
    (home / "out").write_text(str(sum(bool(record.units) for record in records)))
with Watchdog(budget, interrupt) as watchdog:
    session = Session(home / "work", budget, interrupt, progress=False, watchdog=watchdog)
    run_pairs(pairs, assembly, session, publish)
"""


def test_the_watchdog_writes_and_leaves_where_the_engine_is_stuck(tmp_path: Path) -> None:
    code = WATCHED.format(path=[str(ROOT), str(ROOT / "tests" / "support")])
    started = time.monotonic()
    made = subprocess.run([sys.executable, "-c", code, str(tmp_path)], timeout=30, check=False)
    assert made.returncode == 0
    assert time.monotonic() - started < 12  # imports, writing pictures, 3 s
    assert int((tmp_path / "out").read_text()) > 5


KILLED = """
import sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from rectified import THREE_UNITS, RectifiedMatcher
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.engine.submit import submit

if __name__ == "__main__":
    home = Path(sys.argv[1])
    images = sorted((home / "pairs").iterdir())
    pairs = [Pair(f"set;{{n:03d}}", "set", *map(str, images[2 * n : 2 * n + 2])) for n in range(len(images) // 2)]
    assembly = assemble(THREE_UNITS, matchers={{"rectified": RectifiedMatcher(seconds=0.02)}}, device="cpu")
    session = Session(home / "work", Budget(time.monotonic()), Interrupt(), progress=False, workers=1)
    submit(pairs, assembly, session, home / "submission.csv")
"""


def orphans(of: str) -> list[int]:
    """Worker processes that were started by the process of that id, by what they were told at their start."""
    found = []
    for status in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = status.read_bytes().decode(errors="replace")
        except OSError:
            continue
        if "spawn_main" in line and f"parent_pid={of}," in line:
            found.append(int(status.parent.name))
    return found


@pytest.mark.parametrize("moments", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_a_parent_killed_at_any_moment_leaves_a_whole_file_no_orphans_and_a_run_to_resume(
    undisturbed: RunReport, tmp_path: Path, moments: int
) -> None:
    pairs = write_pairs(tmp_path / "pairs", COUNT)
    script = tmp_path / "run.py"
    script.write_text(KILLED.format(path=[str(ROOT), str(ROOT / "tests" / "support")]))
    rng = random.Random(moments)
    for _ in range(moments):
        running = subprocess.Popen([sys.executable, str(script), str(tmp_path)])
        time.sleep(rng.uniform(0.5, 5.0))
        running.send_signal(signal.SIGKILL)
        running.wait()
        if (tmp_path / "submission.csv").exists():
            assert submission_problems(tmp_path / "submission.csv", [pair.id for pair in pairs]) == []
        deadline = time.monotonic() + 5
        while orphans(str(running.pid)) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert orphans(str(running.pid)) == []
    assert subprocess.run([sys.executable, str(script), str(tmp_path)], check=False).returncode == 0
    db = sqlite3.connect(tmp_path / "work" / "journal.sqlite")
    stored = [row[0] for row in db.execute("SELECT fundamental FROM pair ORDER BY pair")]
    db.close()
    assert stored == matrices(undisturbed.records)


def test_an_interrupt_reaches_workers_through_the_parent(pairs: list[Pair], tmp_path: Path) -> None:
    started = time.monotonic()
    matcher = RectifiedMatcher(seconds=0.3)
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "work", interrupt=interrupt_after(4.0), workers=1)
    assert report.ending is Ending.INTERRUPTED
    assert time.monotonic() - started < 9
    assert any(record.has(SWEEP) for record in report.records)


def test_a_worker_that_cannot_be_started_again_ends_the_run_with_every_row_there(
    pairs: list[Pair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_life(assembly: Assembly, _: object) -> Pool:
        return Pool([process_place(partial(pipeline_once, assembly, tmp_path / "marker"))], assembly.recipe)

    monkeypatch.setattr(session, "pool_of", one_life)
    report = run(pairs, THREE_UNITS, FaultyMatcher(), tmp_path / "work", workers=1)
    assert report.ending is Ending.NO_WORKER
    assert any("no worker could be started" in fault for fault in report.faults)
    assert report.records[0].has(SWEEP)
    assert len(report.records) == COUNT


def test_workers_that_die_while_they_load_are_bad_input() -> None:
    pool = Pool([process_place(die)], THREE_UNITS)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="no worker could be started: the worker died: signal SIGKILL"):
        pool.start()
    assert pool.close()


def test_an_image_replaced_after_the_run_is_matched_anew(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path / "pairs", 5)
    first = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    shutil.copy(pairs[4].image0, pairs[VICTIM].image0)
    os.utime(pairs[0].image0)
    with pytest.warns(UserWarning, match="images have changed since they were matched: 1 pairs are matched anew"):
        again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    anew = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "anew")
    assert matrices(again.records) == matrices(anew.records)
    changed = [one != other for one, other in zip(matrices(first.records), matrices(again.records), strict=True)]
    assert changed == [False, False, False, True, False]
    assert again.resumed == 4


def test_a_table_whose_rows_name_other_images_is_another_test_set(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path / "pairs", 3)
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    pairs[1] = replace(pairs[1], file0=pairs[1].file1, file1=pairs[1].file0)
    with pytest.raises(UserError, match="belongs to another run: its test set differ"):
        run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")


def test_a_supervisor_that_meets_an_unexpected_error_gives_the_job_back(
    pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_job, broken = ProcessWorker.run, [True]

    def fail_once(worker: ProcessWorker, job: Job) -> object:
        if broken.pop() if broken else False:
            raise pickle.UnpicklingError("what came was no answer")
        return run_job(worker, job)

    monkeypatch.setattr(ProcessWorker, "run", fail_once)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", workers=1)
    assert report.ending is Ending.COMPLETE
    assert report.faults == ("a job was lost: the worker failed: UnpicklingError: what came was no answer",)
    assert {record.units[0].failure for record in report.records if not record.units[0].matches} <= {
        "given up: the worker failed: UnpicklingError: what came was no answer"
    }


def test_a_job_for_workers_that_were_all_given_up_comes_back(tmp_path: Path) -> None:
    pool = Pool([process_place(die)], THREE_UNITS)  # type: ignore[arg-type]
    with pytest.raises(UserError):
        pool.start()
    pool.submit(Job(Phase.SWEEP, (0,), (SWEEP,), (1.0,), time.monotonic() + 5, 5.0))
    back = pool.next(time.monotonic() + 5)
    assert isinstance(back, JobFailure)
    assert back.cause is Cause.NO_WORKER
    pool.close()


GUARDED = """
import multiprocessing, os, signal, sys, time
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Watchdog

if __name__ == "__main__":
    with Watchdog(Budget(time.monotonic(), float(sys.argv[1])), Interrupt()) as watchdog:
        {body}
"""


def guarded(body: str, limit: str) -> subprocess.CompletedProcess[str]:
    code = GUARDED.format(body=body)
    return subprocess.run([sys.executable, "-c", code, limit], capture_output=True, text=True, check=False)


def test_a_child_that_was_stopped_does_not_outlive_the_watchdog() -> None:
    child = "multiprocessing.get_context('fork').Process(target=time.sleep, args=[600], daemon=True)"
    stop = "os.kill(child.pid, signal.SIGSTOP); print(child.pid, flush=True)"
    done = guarded(f"child = {child}; child.start(); {stop}; time.sleep(600)", "4")
    assert done.returncode == 1  # nothing was written
    assert "before a first version of the submission was written" in done.stderr
    status = Path(f"/proc/{done.stdout.strip()}/stat")
    deadline = time.monotonic() + 30
    while status.exists() and status.read_text().split()[2] != "Z":  # dead, though nobody has asked of it yet
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_the_watchdog_leaves_though_writing_hangs() -> None:
    started = time.monotonic()
    done = guarded("watchdog.save = lambda: time.sleep(600) or ''; time.sleep(600)", "4")
    assert done.returncode == 1
    assert time.monotonic() - started > 3


def test_the_watchdog_keeps_the_status_of_a_run_that_is_left_while_it_tells_of_it() -> None:
    assert guarded("watchdog.save = lambda: ''; watchdog.status = 1; time.sleep(600)", "4").returncode == 1
    assert guarded("watchdog.save = lambda: ''; time.sleep(600)", "4").returncode == 0


def test_a_limit_of_ten_million_years_is_none() -> None:
    done = guarded("time.sleep(0.5); print('ended by itself')", "359999999996400")
    assert (done.returncode, done.stdout, done.stderr) == (0, "ended by itself\n", "")


def test_writing_that_takes_long_is_begun_so_much_earlier(tmp_path: Path) -> None:
    versions = []

    def publish(records: object) -> None:
        time.sleep(0.4)
        versions.append(time.monotonic())

    started = time.monotonic()
    matcher = RectifiedMatcher(seconds=0.05)
    run(write_pairs(tmp_path / "pairs", 60), THREE_UNITS, matcher, tmp_path / "work", limit=8.0, publish=publish)
    assert len(versions) == 2
    assert versions[-1] - started < 8.0 - 1.5 / 2 - 0.6
