"""Readers of a store, beside a run and in a read-only directory."""

import os
import shutil
import tempfile
import threading
from contextlib import closing
from pathlib import Path

import pytest
from rectified import THREE_UNITS, RectifiedMatcher, matrices, run
from store_room import (
    Room,
    matches_in,
)

from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.store.database import FILE_NAME, Store
from mkpc_kaggle.engine.store.dataframes import (
    pair_tables,
    results,
)
from mkpc_kaggle.engine.store.sqlite_file import connected
from mkpc_kaggle.engine.store.tables import UnitPoints
from mkpc_kaggle.errors import UserError


def test_a_reader_that_has_the_file_open_neither_blocks_a_run_nor_is_blocked(
    whole: Room, tmp_path: Path
) -> None:
    whole.store.close()
    # A transaction, as of a backup or of a notebook
    with Store.read(tmp_path) as reader:
        before = pair_tables(reader).pairs
        with Store.open(tmp_path) as store:
            store.put([UnitPoints("new", "u", 1)])
            assert store.flush() == ""
            with Store.read(tmp_path) as other:
                assert matches_in(other, ["new"]) == {"new": 1}
        assert pair_tables(reader).pairs.equals(before)
    with Store.read(tmp_path) as again:
        assert matches_in(again, ["new"]) == {"new": 1}
    # Nor does a reader leave files of SQLite's behind.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["journal.lock", "journal.sqlite"]


@pytest.mark.parametrize("mode", ["DELETE", "WAL"])
def test_a_reader_of_a_copy_in_another_mode_does_not_block_a_run(
    whole: Room, tmp_path: Path, mode: str
) -> None:
    whole.store.close()
    with closing(connected(tmp_path / FILE_NAME)) as db:
        db.execute(f"PRAGMA journal_mode = {mode}")
    with closing(connected(tmp_path / FILE_NAME, "mode=ro")) as reader:
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM points").fetchone()[0] > 0
        with Store.open(tmp_path) as store:
            store.put([UnitPoints("new", "u", 1)])
            assert matches_in(store, ["new"]) == {"new": 1}


def test_readers_in_a_loop_beside_a_run_work_or_have_one_line(pairs, undisturbed, tmp_path) -> None:
    work = tmp_path / "work"
    ended = threading.Event()
    read = []
    refused = []

    def loop() -> None:
        while not ended.is_set():
            try:
                read.append(len(results(work).pairs))
            except UserError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=loop) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(2):
        report = run(pairs, THREE_UNITS, RectifiedMatcher(seconds=0.005), work)
        assert (report.ending, report.faults) == (Ending.COMPLETE, ())
        assert matrices(report) == matrices(undisturbed)
    ended.set()
    for thread in threads:
        thread.join()
    assert 12 in read
    # Before the first table of pairs
    reasons = ("has no journal.sqlite", "has no results yet", "the run has not begun")
    assert [text for text in refused if not any(reason in text for reason in reasons)] == []


def test_the_log_of_a_killed_run_in_a_read_only_directory_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "work"
    with Store.open(work) as store:
        store.put([UnitPoints("in the log", "u", 1)])
        shutil.copytree(work, tmp_path / "killed")
    killed = tmp_path / "killed"
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    # As root, a test can write anywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with Store.read(killed) as reader:
        # One transaction, after a kill
        assert matches_in(reader, ["in the log"]) == {"in the log": 1}
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed", "work"], "no copy is left"
