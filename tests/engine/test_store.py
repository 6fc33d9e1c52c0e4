"""The store: rows are saved all or none, a full disk costs none, a prune removes the unused ones."""

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, matrices, run
from simulator import VirtualClock
from store_room import (
    Room,
    matches_in,
)

from mkpc_kaggle.engine import run as engine_run
from mkpc_kaggle.engine.matching import Matching
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.run import EventLog
from mkpc_kaggle.engine.store import database as store_module
from mkpc_kaggle.engine.store.database import FILE_NAME, Store
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.sqlite_file import connected
from mkpc_kaggle.engine.store.tables import Feature, PairEstimate, SceneRecord, UnitPoints
from mkpc_kaggle.errors import UserError


def results_in(store: Store) -> set[str]:
    """The keys of all results of a store that a prune may remove."""
    return {row.key for kind in (UnitPoints, PairEstimate, SceneRecord) for row in store.all(kind)}


def test_results_are_stored_all_or_none(room: Room) -> None:
    good = SceneRecord("one", seconds=1.0, key="a")
    for bad in (
        SceneRecord("one", seconds=np.nan, key="b"),
        SceneRecord("one", images=1.5, key="b"),
    ):
        with pytest.raises(sqlite3.IntegrityError):
            room.store.put([good, bad])
        assert room.store.get(SceneRecord, ["a", "b"]) == {}


def test_results_that_a_full_disk_refuses_stay_in_memory_and_are_written_later(
    tmp_path: Path,
) -> None:
    rows = [UnitPoints(f"key {n}", "u", n, data=bytes(600)) for n in range(200)]
    with Store.open(tmp_path) as store:
        # SQLite then reports a full disk after five more pages.
        (pages,) = store._db.execute("PRAGMA page_count").fetchone()
        store._db.execute(f"PRAGMA max_page_count = {pages + 5}")
        for row in rows:
            store.put([row])
        assert "full" in store.trouble
        assert matches_in(store, [row.key for row in rows]) == {
            row.key: row.matches for row in rows
        }
        # The worker that estimates F gets these points, too.
        last = rows[-1]
        assert store.source(UnitPoints, [last.key]).data([last.key]) == {last.key: last.data}
        # The user deletes files: the next write takes all.
        store._db.execute("PRAGMA max_page_count = 100000")
    with Store.read(tmp_path) as again:
        assert len(again.data(UnitPoints, [row.key for row in rows])) == 200


# Puts a result into the store in argv[1], and prints the results that it has, and why they stay in memory.
PUT = """
import resource, sys
from pathlib import Path
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.tables import UnitPoints

limit = 1024 * int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
with Store.open(Path(sys.argv[1])) as store:
    store.put([UnitPoints("new", "u", 2)])
    rows = store.get(UnitPoints, ["former", "new"])
    print({key: row.matches for key, row in rows.items()}, bool(store.trouble))
"""


# The file can have a first page, but SQLite's index of 32 kB fails.
@pytest.mark.parametrize("kib", [4, 20])
@pytest.mark.parametrize("former", [{}, {"former": 1}], ids=["new", "resumed"])
def test_a_disk_that_is_full_from_the_start_costs_no_result(
    tmp_path: Path, kib: int, former: dict[str, int]
) -> None:
    if former:
        with Store.open(tmp_path) as store:
            store.put(UnitPoints(key, "u", count) for key, count in former.items())
    process = put_into(tmp_path, kib)
    assert process.stderr == ""
    assert process.stdout == f"{former | {'new': 2}} True\n"


def put_into(directory: Path, kib: int) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", PUT, str(directory), str(kib)],
        check=False,
        text=True,
        capture_output=True,
    )


def test_a_disk_without_a_free_byte_is_refused_in_one_line(tmp_path: Path) -> None:
    last = put_into(tmp_path, 0).stderr.splitlines()[-1]
    assert last.endswith(
        f"UserError: the work directory {tmp_path} cannot be written: disk I/O error"
    )


class FullDisk:
    """A connection whose disk has no room for statements that begin with a word."""

    def __init__(self, connection: sqlite3.Connection, word: str) -> None:
        self._connection = connection
        self._word = word

    def execute(self, statement: str, *values: object) -> sqlite3.Cursor:
        if statement.startswith(self._word):
            raise sqlite3.OperationalError("database or disk is full")
        return self._connection.execute(statement, *values)

    def __getattr__(self, name: str) -> object:
        return getattr(self._connection, name)


@pytest.mark.parametrize(
    ("word", "outcome", "kept"),
    [("DELETE", "nothing was removed", True), ("VACUUM", "unused results are removed", False)],
)
def test_a_prune_on_a_full_disk_is_one_line_and_loses_nothing(
    whole: Room, tmp_path: Path, monkeypatch, word, outcome, kept
) -> None:
    whole.store.put([UnitPoints("unnamed", "u", data=bytes(1 << 16))])
    named = set(Published.of(whole.store).keys)
    whole.store.close()
    real = store_module.connected
    monkeypatch.setattr(
        store_module, "connected", lambda *options, **more: FullDisk(real(*options, **more), word)
    )
    told = rf"sqlite: {outcome}.*: database or disk is full; make room on the disk"
    with Store.open(tmp_path) as store, pytest.raises(UserError, match=told):
        store.prune(Published.of(store).keys)
    monkeypatch.undo()
    with Store.read(tmp_path) as store:
        assert results_in(store) == named | ({"unnamed"} if kept else set())


def test_a_prune_removes_what_the_table_of_pairs_does_not_name(whole: Room, tmp_path: Path) -> None:
    named = set(Published.of(whole.store).keys)
    unnamed = UnitPoints("unnamed", "u", data=bytes(1 << 20))
    features = Feature("features", data=b"kept")
    whole.store.put([unnamed, features])
    whole.store.close()
    before = (tmp_path / FILE_NAME).stat().st_size
    with Store.open(tmp_path) as store:
        freed = store.prune(Published.of(store).keys)
    assert freed >= 1 << 20
    assert (tmp_path / FILE_NAME).stat().st_size == before - freed
    with Store.read(tmp_path) as store:
        assert results_in(store) == named
        # Features belong to images, which the table of pairs does not name.
        assert store.data(Feature, ["features"]) == {"features": b"kept"}


def test_files_in_the_place_of_the_store_or_its_lock_are_named(tmp_path: Path) -> None:
    for name in ("journal.lock", "journal.sqlite"):
        directory = tmp_path / f"with {name}"
        directory.mkdir()
        # Opening a pipe without a writer would block forever.
        os.mkfifo(directory / name)
        with pytest.raises(UserError, match=f"{name} is not a regular file"):
            Store.open(directory)
    (tmp_path / "journal.lock").write_bytes(b"not a database" * 100)
    with pytest.raises(UserError, match=r"journal\.lock is damaged .*remove it"):
        Store.open(tmp_path)


def test_a_store_in_use_is_refused(tmp_path: Path) -> None:
    with Store.open(tmp_path), pytest.raises(UserError, match="is another run using it"):
        Store.open(tmp_path)


def test_a_refused_store_holds_no_lock_and_no_file(tmp_path: Path) -> None:
    Store.open(tmp_path).close()
    (tmp_path / FILE_NAME).write_bytes(b"not a database" * 100)
    with pytest.raises(UserError) as caught:
        Store.open(tmp_path)
    # A notebook keeps the last traceback, and with it the store's objects.
    assert caught
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    open_files = [str(link.readlink()) for link in links]
    assert not [name for name in open_files if name.startswith(str(tmp_path))]
    Store.open(tmp_path, fresh=True).close()


def test_a_lock_of_another_program_is_waited_for_once_in_half_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr("mkpc_kaggle.engine.store.database.monotonic", lambda: clock[0])
    with Store.open(tmp_path) as store, closing(connected(tmp_path / FILE_NAME)) as other:
        tried = []
        store._db.set_trace_callback(lambda text: tried.append("BEGIN" in text))
        other.execute("BEGIN IMMEDIATE")
        for number in range(60):
            clock[0] = float(number)
            store.put([UnitPoints(f"key {number}", "u", number)])
        assert sum(tried) == 2
        assert matches_in(store, ["key 59"]) == {"key 59": 59}
        assert "is locked" in store.trouble
        with pytest.raises(sqlite3.IntegrityError):  # also while nothing is written
            store.put([UnitPoints("bad", "u", match_seconds=np.nan)])
        other.execute("ROLLBACK")
        # The end of the run, which has lost nothing
        assert store.flush() == ""
        assert store.trouble == ""
    with Store.read(tmp_path) as again:
        assert len(again.all(UnitPoints)) == 60


def test_a_directory_that_is_moved_during_a_run_costs_no_result(
    pairs, undisturbed, tmp_path, monkeypatch
) -> None:
    moved = iter([tmp_path / "moved"])
    use = Matching._use

    def use_and_move(*arguments: object) -> None:
        use(*arguments)
        for target in moved:
            (tmp_path / "work").rename(target)

    monkeypatch.setattr(Matching, "_use", use_and_move)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert matrices(report) == matrices(undisturbed)
    assert "was moved or removed during the run" in report.unsaved
    assert report.faults == (report.unsaved,)
    # The results went with the directory.
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "moved")
    assert (again.units_run, again.estimated, again.faults) == (0, 0, ())


def test_the_lists_of_faults_and_decisions_end_at_a_number(tmp_path, monkeypatch):
    monkeypatch.setattr(engine_run, "MAX_FAULTS", 3)
    monkeypatch.setattr(engine_run, "MAX_PLANS", 3)
    log = EventLog(tmp_path, Budget(0.0, clock=VirtualClock()))
    for number in range(10):
        log.fault(f"fault {number}")
        log.explain(f"decision {number}")
    assert log.faults == ["fault 0", "fault 1", "fault 2", "further faults are not listed"]
    texts = [event.text for event in log.plans]
    assert texts == ["decision 0", "decision 1", "decision 2", "further decisions are not listed"]
