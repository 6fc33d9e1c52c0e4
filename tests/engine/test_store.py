"""The store: rows are saved all or none, a full disk costs none, readers do not block a run."""

import resource
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from store_room import Room

from mkpc_kaggle.engine.frames import results_of
from mkpc_kaggle.engine.store import FILE_NAME, Store, connected
from mkpc_kaggle.errors import UserError

POINTS: Any = ("points", 0, 0, 0.0, None, None, "", "", b"")


def put(store: Store, *numbers: int) -> None:
    store.put({"result": [(f"key {number}", "[]" * 300) for number in numbers]})


def keys_in(store: Store, count: int = 200) -> set[str]:
    return {
        key for (key,) in store.select("result", "key", [f"key {n}" for n in range(count)])
    }


def test_rows_are_saved_all_or_none(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        with pytest.raises(sqlite3.ProgrammingError):
            store.put({"result": [("key 0", "[]"), ("key 1", "[]", "more")]})
        assert keys_in(store) == set()


def test_rows_that_a_full_disk_refuses_stay_in_memory_and_are_written_later(
    tmp_path: Path,
) -> None:
    with Store.open(tmp_path) as store:
        # SQLite then reports a full disk after five more pages.
        (pages,) = store.db.execute("PRAGMA main.page_count").fetchone()
        store.db.execute(f"PRAGMA main.max_page_count = {pages + 5}")
        for number in range(200):
            put(store, number)
        assert "full" in store.trouble
        assert len(keys_in(store)) == 200
        # A row that is written again is the one in memory.
        store.put({"run": [(0, 1, "first")]})
        store.put({"run": [(0, 1, "second")]})
        assert store.db.execute("SELECT about FROM run").fetchall() == [("second",)]
        # The worker that estimates F gets points that only memory has.
        store.put({"points": [POINTS]})
        assert len(store.source(["points"]).matches(["points"])["points"]) == 0
        # The user deletes files: the next write takes all.
        store.db.execute("PRAGMA main.max_page_count = 100000")
        assert store.flush() == ""
    with Store.read(tmp_path) as again:
        assert len(keys_in(again)) == 200


# Puts a row into the store in argv[1], and prints the rows that it has, and why they stay in memory.
PUT = """
import resource, sys
from pathlib import Path
from mkpc_kaggle.engine.store import Store

limit = 1024 * int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
with Store.open(Path(sys.argv[1])) as store:
    store.put({"result": [("new", "2")]})
    print(store.facts(["former", "new"]), bool(store.trouble))
    store.source(["points"]).matches(["points"] if store.facts(["former"]) else [])
"""


# The file can have a first page, but SQLite's index of 32 kB fails.
@pytest.mark.parametrize("kib", [4, 20])
@pytest.mark.parametrize("former", [{}, {"former": "1"}], ids=["new", "resumed"])
def test_a_disk_that_is_full_from_the_start_costs_no_result(
    tmp_path: Path, kib: int, former: dict[str, str]
) -> None:
    if former:
        with Store.open(tmp_path) as store:
            store.put({"result": former.items(), "points": [POINTS]})
    process = put_into(tmp_path, kib)
    assert process.stderr == ""
    assert process.stdout in (
        f"{former | {'new': '2'}} True\n",
        f"{dict(sorted((former | {'new': '2'}).items(), reverse=True))} True\n",
    )


def put_into(directory: Path, kib: int) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", PUT, str(directory), str(kib)],
        check=False,
        text=True,
        capture_output=True,
    )


def test_the_tables_of_a_long_run_need_no_disk(whole: Room) -> None:
    db = whole.store.db
    db.execute(
        """REPLACE INTO main.pair SELECT number.value, pair.id || number.value, batch, image0, image1, units,
        estimate, F, source, choice, error FROM main.pair, json_each(?) AS number WHERE pair.key = 0""",
        [str([*range(9000)])],
    )
    db.execute("UPDATE main.run SET rows = 9000")
    free, limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limit))
    try:
        found = results_of(whole.store)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (free, limit))
    assert len(found.units) > len(found.pairs) == 9000


def test_a_disk_without_a_free_byte_is_refused_in_one_line(tmp_path: Path) -> None:
    last = put_into(tmp_path, 0).stderr.splitlines()[-1]
    assert last.endswith(
        f"UserError: the work directory {tmp_path} cannot be written: disk I/O error"
    )


def test_a_store_in_use_is_refused(tmp_path: Path) -> None:
    with Store.open(tmp_path), pytest.raises(UserError, match="is another run using it"):
        Store.open(tmp_path)


def test_a_damaged_file_and_one_of_another_format_are_refused_and_fresh_is_the_way_out(
    whole: Room, tmp_path: Path
) -> None:
    whole.store.close()
    path = tmp_path / FILE_NAME
    good = path.read_bytes()
    for content, told in (
        (b"not a database" * 100, "is damaged"),
        (good[:8192] + b"x" * (len(good) - 8192), "is damaged"),
    ):
        path.write_bytes(content)
        for opened in (Store.open, Store.read):
            with pytest.raises(UserError, match=told):
                opened(tmp_path)
    path.write_bytes(good)
    with closing(connected(path)) as db:
        db.execute("PRAGMA user_version = 7")
    with pytest.raises(UserError, match=r"another version of this program.*--fresh"):
        Store.open(tmp_path)
    # A refused store holds no lock and no file.
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert not [link for link in links if str(link.readlink()).startswith(str(tmp_path))]
    with Store.open(tmp_path, fresh=True) as store:
        assert store.facts(["any"]) == {}


def test_a_lock_of_another_program_is_waited_for_once_in_half_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr("mkpc_kaggle.engine.store.monotonic", lambda: clock[0])
    with Store.open(tmp_path) as store, closing(connected(tmp_path / FILE_NAME)) as other:
        tried = []
        store.db.set_trace_callback(lambda text: tried.append("INTO main" in text))
        other.execute("BEGIN IMMEDIATE")
        for number in range(60):
            clock[0] = float(number)
            put(store, number)
        assert sum(tried) == 2
        assert len(keys_in(store)) == 60
        assert "is locked" in store.trouble
        other.execute("ROLLBACK")
        # The end of the run, which has lost nothing
        assert store.flush() == ""
    with Store.read(tmp_path) as again:
        assert len(keys_in(again)) == 60


def test_a_reader_that_has_the_file_open_neither_blocks_a_run_nor_is_blocked(
    whole: Room, tmp_path: Path
) -> None:
    whole.store.close()
    # A transaction, as of a backup or of a notebook
    with Store.read(tmp_path) as reader:
        before = results_of(reader).pairs
        with Store.open(tmp_path) as store:
            put(store, 1)
            assert store.flush() == ""
            with Store.read(tmp_path) as other:
                assert keys_in(other) == {"key 1"}
        assert results_of(reader).pairs.equals(before)
    with Store.read(tmp_path) as again:
        assert keys_in(again) == {"key 1"}
    # Nor does a reader leave files of SQLite's behind.
    names = sorted(path.name for path in tmp_path.glob("journal*"))
    assert names == ["journal.lock", "journal.sqlite"]
