"""Stores that are damaged, of another format, or changed by another program."""

import sqlite3
import warnings
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, matrices, run
from store_room import Room

from mkpc_kaggle.engine.matching import Matching
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.store.database import FILE_NAME, Store
from mkpc_kaggle.engine.store.dataframes import (
    pair_tables,
    results,
)
from mkpc_kaggle.engine.store.sqlite_file import connected
from mkpc_kaggle.engine.store.tables import UnitPoints
from mkpc_kaggle.errors import UserError

DAMAGES = [
    (
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = 'x' WHERE name = 'points'",
        "malformed",
    ),
]


@pytest.mark.parametrize(("damage", "told"), DAMAGES)
def test_only_what_sqlite_reports_as_damage_is_damage(
    whole: Room, tmp_path: Path, damage: str, told: str
) -> None:
    whole.store.close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
        db.executescript(damage)
    with pytest.raises(
        UserError, match=rf"journal\.sqlite is damaged \(.*{told}.*delete it with --fresh"
    ):
        Store.open(tmp_path)
    with Store.open(tmp_path, fresh=True) as store:
        assert store.all(UnitPoints) == []


def test_a_bug_in_a_reader_is_no_damage(whole: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    # "Delete your journal" would cost the user hours and hide the bug.
    monkeypatch.setattr("mkpc_kaggle.engine.store.dataframes.PARAMETERS", None)
    with pytest.raises(sqlite3.ProgrammingError):
        pair_tables(whole.store)


def test_an_error_of_the_disk_is_no_damage_and_no_bad_input(
    whole: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing:
        def execute(self, *_: object) -> None:
            error = sqlite3.OperationalError("disk I/O error")
            error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
            raise error

    monkeypatch.setattr(whole.store, "_unsaved", {})
    healthy = whole.store._db
    whole.store._db = Failing()
    with pytest.raises(sqlite3.OperationalError, match="disk I/O error"):
        whole.store.get(UnitPoints, ["key"])
    whole.store._db = healthy


def test_a_store_of_another_format_and_an_old_sqlite_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
        db.execute("CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL)")  # as format 10
        db.execute("PRAGMA user_version = 15")
    with pytest.raises(
        UserError, match=r"another version of this program \(its format is not \d+\).*--fresh"
    ):
        Store.open(tmp_path)
    Store.open(tmp_path, fresh=True).close()
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 36, 0))
    with pytest.raises(UserError, match=r"Python needs 3\.37 or newer"):
        Store.open(tmp_path)


DAMAGED_ROWS = {
    "another number": "UPDATE points SET matches = 7",
    "truncated": "UPDATE points SET data = substr(data, 1, 7)",
    "empty": "UPDATE points SET data = x''",
    "other bytes": "UPDATE points SET data = zeroblob(length(data))",
    "no JSON": "UPDATE points SET regions = '{'",
    "no UTF-8": "UPDATE points SET note = CAST(x'ff41' AS TEXT)",
    "an estimate": "UPDATE estimate SET F = zeroblob(72)",
    "an image": "UPDATE image SET width = 7",
    "the run": "UPDATE run SET about = '{}'",
    "the table of pairs": "UPDATE pair SET points = '[]'",
    "F of the table": "UPDATE pair SET F = zeroblob(72)",
    "an event": "UPDATE event SET text = 'x' || text",
    "exchanged rows": "UPDATE points SET key = 'x' || key",
}


@pytest.mark.parametrize("name", DAMAGED_ROWS)
def test_a_row_that_does_not_fit_its_digest_is_missing_and_computed_again(
    pairs, undisturbed, tmp_path, name, capsys
) -> None:
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    count = edit(tmp_path, DAMAGED_ROWS[name])
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        try:  # a reader has the other rows, or one line
            results(tmp_path)
        except UserError as error:
            assert "the run has not begun" in str(error)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    rows = "1 result" if count == 1 else f"{count} results"
    assert report.faults == (f"{rows} of the journal, damaged, will be computed again",)
    assert f"warning: {report.faults[0]}\n" in capsys.readouterr().err
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == matrices(undisturbed)
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert (again.faults, again.units_run, again.estimated) == ((), 0, 0)
    assert len(results(tmp_path).units) == 36


def edit(directory: Path, script: str) -> int:
    """Change the file of a store as another program. Return the number of changed rows."""
    with closing(connected(directory / FILE_NAME)) as db:
        return db.execute(script).rowcount


TABLES = {
    "no table": "DROP TABLE points",
    "another table": "CREATE TABLE notes (text TEXT)",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON points BEGIN DELETE FROM points; END",
    "another column": "ALTER TABLE points ADD COLUMN more TEXT",
}


@pytest.mark.parametrize("script", TABLES.values(), ids=TABLES)
def test_other_tables_than_the_programs_are_damage_in_one_line(
    whole: Room, tmp_path: Path, script: str
) -> None:
    whole.store.close()
    edit(tmp_path, script)
    for use in (Store.open, Store.read):
        with pytest.raises(UserError, match=r"is damaged \(it has .*delete it with --fresh"):
            use(tmp_path)


def test_a_file_without_results_is_no_other_format(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).touch()
    with pytest.raises(UserError, match="has no results yet"):
        Store.read(tmp_path)


def test_a_log_that_is_overwritten_during_a_run_is_like_a_full_disk(
    pairs, undisturbed, tmp_path, monkeypatch
) -> None:
    spoilt = []
    use = Matching._use

    def use_and_spoil(self: Matching, index: int, *arguments: object) -> None:
        use(self, index, *arguments)
        # After the sweep, whose points the crops of the second unit come from
        if not spoilt and self._run.log.units_run == 11:
            log = tmp_path / f"{FILE_NAME}-wal"
            spoilt.append(log.stat().st_size)
            with log.open("r+b") as stream:
                stream.write(np.random.default_rng(0).bytes(spoilt[0]))

    monkeypatch.setattr(Matching, "_use", use_and_spoil)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert spoilt
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == matrices(undisturbed)
    assert "the journal was damaged during the run" in report.unsaved
    monkeypatch.undo()
    # What the journal lost is computed again.
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert matrices(again) == matrices(undisturbed)
    assert again.unsaved == ""
