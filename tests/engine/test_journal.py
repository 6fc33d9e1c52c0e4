import os
import re
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THREE_UNITS

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.codec import encode
from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.journal import Event, EventKind, Journal
from mkpc_kaggle.engine.records import CameraRecord, PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.scene.choose import Choice, Reason

OURS = {"recipe": {"a": 1}, "test set": "x"}
PAIRS = [Pair(str(number), "batch", "a.png", "b.png") for number in range(8)]
UNITS = {unit.name: unit for unit in THREE_UNITS.units}


def outcome(index: int = 7, seed: int = 0) -> Outcome:
    rng = np.random.default_rng(seed)
    results = tuple(
        UnitResult(unit, Matches(rng.random((n, 2)), rng.random((n, 2)), rng.random(n)), 0.5, 0.25)
        for unit, n in ((SWEEP, 30), (SECOND, 0))
    )
    regions = (
        CriticalRegion(Box(1, 2, 30, 40), RegionReason.CROPPED, 3, 2),
        CriticalRegion(Box(0, 0, 5, 6), RegionReason.TOO_SMALL),
    )
    magsac = rng.random((3, 3)) if seed else None
    found = Estimate(ModelKind.F, rng.random((3, 3)), rng.random(30) < 0.5, magsac=magsac)
    match = PairMatch(results, regions, found)
    match = replace(match, decode_seconds=0.1, cluster_seconds=0.2, estimate_seconds=0.3)
    return Outcome(PairRecord.of(index, match), results)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path, OURS) as journal:
        yield journal


def test_what_is_saved_is_there_after_opening_again(tmp_path: Path) -> None:
    saved = [outcome(3, seed=0), outcome(7, seed=2)]
    with Journal(tmp_path, OURS) as journal:
        journal.save(saved)
    with Journal(tmp_path, OURS) as again:
        records = again.records()
        assert list(records) == [3, 7]
        for pair in saved:
            assert encode(records[pair.record.index]) == encode(pair.record)
            for before, after in zip(pair.results, again.results(pair.record, UNITS), strict=True):
                assert after.unit == before.unit
                assert after.matches.points0.tobytes() == before.matches.points0.tobytes()
                assert after.matches.scores.tobytes() == before.matches.scores.tobytes()


def points_of(journal: Journal, pair: int) -> int:
    return sum(len(result.matches) for result in journal.results(journal.records()[pair], UNITS))


def test_a_job_is_saved_whole_or_not_at_all(journal: Journal) -> None:
    broken = Outcome(PairRecord(8, object(), ""))  # type: ignore[arg-type]
    with pytest.raises(AttributeError):
        journal.save([outcome(3), broken])
    assert journal.records() == {}
    journal.save([outcome(3)])
    assert list(journal.records()) == [3]
    journal._db.execute("CREATE TEMP TRIGGER t BEFORE INSERT ON points BEGIN SELECT RAISE(ABORT, 'no room'); END")
    with pytest.raises(sqlite3.IntegrityError, match="no room"):
        journal.save([outcome(5)])
    assert list(journal.records()) == [3], "what was written before is taken back"


def test_a_journal_of_another_run_is_refused_and_says_what_differs(tmp_path: Path) -> None:
    Journal(tmp_path, OURS).close()
    with pytest.raises(UserError, match=r"another run .different recipe.*--fresh"):
        Journal(tmp_path, {**OURS, "recipe": {"a": 2}})
    Journal(tmp_path, OURS).close()


def test_fresh_forgets_what_was_there(tmp_path: Path) -> None:
    with Journal(tmp_path, OURS) as journal:
        journal.save([outcome()])
    with Journal(tmp_path, {**OURS, "recipe": {}}, fresh=True) as journal:
        assert journal.records() == {}


def test_it_is_known_of_how_many_results_a_scene_was_made(tmp_path: Path) -> None:
    damaged_journal(tmp_path, "SELECT 1")
    with Journal(tmp_path, OURS) as journal:
        (scene,) = journal.scenes()
        assert scene.unit_results == 3
        assert journal.records()[3].source == "scene"


def test_what_a_full_disk_refuses_is_known_and_written_when_there_is_room(journal: Journal) -> None:
    journal._db.execute("PRAGMA max_page_count = 12")
    index = 0
    with pytest.raises(sqlite3.OperationalError, match="full"):
        for index in range(200):
            journal.save([outcome(index, seed=index)])
    assert index not in journal.records()
    assert sum(len(result.matches) for result in journal.results(outcome(index).record, UNITS)) == 30
    journal._db.execute("PRAGMA max_page_count = 100000")
    journal.save([outcome(999)])
    assert set(journal.records()) == {*range(index + 1), 999}
    assert points_of(journal, index) == 30


def damaged_journal(directory: Path, damage: str) -> Path:
    """A journal of two pairs and a scene, after a statement that no run makes."""
    journal = Journal(directory, OURS, pairs=PAIRS)
    journal.note(Event(EventKind.START, 0.0, ""))
    journal.save([outcome(3, seed=1), outcome(7, seed=2)])
    camera = CameraRecord("a", 0, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 500.0, Size(640, 480), 9)
    scene = SceneRecord("batch", 2, 2, 1, 9, 3, 1.5, "", (camera,), (((0.0, 0.0, 5.0),),))
    chosen = {3: Choice(np.eye(3), Reason.SCENE), 7: Choice(None, Reason.UNREGISTERED)}
    records = journal.records()
    journal.save_scene(scene, [replace(records[index], scene=choice) for index, choice in chosen.items()])
    journal.close()
    with closing(sqlite3.connect(directory / "journal.sqlite")) as db:
        db.execute(damage.format())
        db.commit()
    return directory / "journal.sqlite"


def read_all(journal: Journal) -> None:
    for read in (journal.records, journal.scenes, journal.pairs, journal.events):
        read()
    for record in journal.records().values():
        journal.results(record, UNITS)


def pairs_with(path: str, value: str) -> str:
    """Another JSON value in all records of pairs, whose fields are in their order."""
    return f"UPDATE pair SET value = json_replace(value, '$[{path}]', json('{value}'))"


DAMAGES = [
    pairs_with("1", "[[1e999, 0, 0], [0, 0, 1], [0, 1, 0]]"),
    pairs_with("1", "[[0, 0, 0], [0, 0, 0], [0, 0, 0]]"),
    "UPDATE pair SET value = cast(x'ff' AS TEXT)",
    pairs_with("5", '"x"'),
    pairs_with("11", "[1]"),
    pairs_with("3][0][2", '"x"'),
    pairs_with("3][0][0", '"another"'),
    "UPDATE points SET points = zeroblob(1000)",
    f"UPDATE points SET points = x'{zlib.compress(bytes(100_000_000)).hex()}'",
    pairs_with("3][0][4", "1e999"),
    pairs_with("4][0][1", '"x"'),
    pairs_with("4][0][0", "[9, 9, 1, 1]"),
    "UPDATE pair SET value = json_remove(value, '$[4][1]')",
    pairs_with("8", '[[1, 2], "both cameras are known"]'),
    pairs_with("8", '[null, "x"]'),
    pairs_with("8", '[[[1e999, 0, 0], [0, 0, 1], [0, 1, 0]], "both cameras are known"]'),
    'UPDATE event SET value = \'["x", "never", ""]\'',
    "UPDATE sample SET value = cast(x'ff00' AS BLOB)",
    "UPDATE run SET value = printf('%.*c', 5000, '9')",
    "INSERT INTO scene VALUES ('other', '[\"other\", 1, 1]')",
    "UPDATE scene SET value = '['",
    "UPDATE scene SET value = json_replace(value, '$[8][0]', json('{{}}'))",
    "UPDATE scene SET value = json_replace(value, '$[8][0][2]', json('[0, null, 1]'))",
    "UPDATE scene SET value = json_replace(value, '$[9]', json('[[0.0, 1.0]]'))",
    "UPDATE run SET value = '{{'",
    f"UPDATE run SET value = '{'[' * 100_000}'",
    "DROP TABLE points",
    "ALTER TABLE scene DROP COLUMN value",
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_anywhere_is_told_as_such(tmp_path: Path, damage: str) -> None:
    path = damaged_journal(tmp_path, damage)
    told = rf"{re.escape(str(path))} is damaged \(.*start anew with --fresh"
    with pytest.raises(UserError, match=told), Journal(tmp_path, OURS) as journal:
        read_all(journal)
    with Journal(tmp_path, OURS, fresh=True) as journal:
        assert journal.records() == {}


def test_pairs_that_no_test_set_has_are_damage(tmp_path: Path) -> None:
    damaged_journal(tmp_path, pairs_with("0", "-1"))
    with Journal(tmp_path, OURS) as journal, pytest.raises(UserError, match="damaged"):
        journal.forget_outdated(PAIRS, has_scenes=True)


def test_bytes_damaged_at_random_never_end_in_a_traceback(tmp_path: Path) -> None:
    path = damaged_journal(tmp_path, "SELECT 1")
    good, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for number in range(60):
        data = bytearray(good)
        start = int(rng.integers(len(good)))
        data[start : start + 200] = rng.bytes(200)
        path.write_bytes(bytes(data[: len(good)]) if number % 3 else good[:start])
        for name in ("journal.sqlite-wal", "journal.sqlite-journal"):
            (tmp_path / name).unlink(missing_ok=True)
        try:
            with Journal(tmp_path, OURS) as journal:
                read_all(journal)
                assert all(np.isfinite(record.chosen_fundamental).all() for record in journal.records().values())
        except UserError:
            refused += 1
    assert 10 < refused < 60


def test_a_file_in_the_place_of_the_lock_is_named(tmp_path: Path) -> None:
    (tmp_path / "journal.lock").write_bytes(b"not a database" * 100)
    with pytest.raises(UserError, match=r"journal\.lock is damaged .*remove it"):
        Journal(tmp_path, OURS)


def test_a_pipe_in_the_place_of_the_journal_is_refused(tmp_path: Path) -> None:
    for number, name in enumerate(("journal.lock", "journal.sqlite")):
        directory = tmp_path / str(number)
        directory.mkdir()
        os.mkfifo(directory / name)
        with pytest.raises(UserError, match=f"{name} is not a regular file"):
            Journal(directory, OURS)


def test_a_refused_journal_holds_no_lock_and_no_file(tmp_path: Path) -> None:
    Journal(tmp_path, OURS).close()
    kept = []
    for belongs_to, damage in (({**OURS, "recipe": {}}, False), (OURS, True)):
        if damage:
            (tmp_path / "journal.sqlite").write_bytes(b"not a database" * 100)
        with pytest.raises(UserError) as caught:
            Journal(tmp_path, belongs_to)
        kept.append(caught)  # as a notebook keeps the last traceback
        open_files = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
        assert not [name for name in open_files if name.startswith(str(tmp_path))]
    Journal(tmp_path, OURS, fresh=True).close()


def test_text_that_is_not_utf8_is_kept_in_letters(journal: Journal) -> None:
    record = PairRecord.untouched(3, os.fsdecode(b"\xff: no such file"))
    journal.save([Outcome(record)])
    journal.note(Event(EventKind.FAULT, 0.0, os.fsdecode(b"\xff")))
    assert journal.records()[3].failure == "\\udcff: no such file"
