"""The durable record of a run: an SQLite file that only the parent writes, one transaction a job."""

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from functools import cache
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import is_unchanged
from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.journal_tables import (
    DRAWN,
    FILE_NAME,
    FORMAT,
    LOCK_NAME,
    SCHEMA,
    About,
    Event,
    JournalTables,
    encode,
    to_blob,
    undamaged,
)
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError, writing


class Journal(JournalTables):
    """The journal of a work directory, made if it is not there; no other run can open it while this one has it.

    ``belongs_to`` says by name what the run computes (recipe, test set, weights). Raises :class:`UserError`
    where the directory cannot be written, another run holds it, or it belongs to something else.

    What the file cannot take (a full disk) is kept in memory, and written with what comes next.
    """

    def __init__(
        self,
        directory: Path,
        belongs_to: Mapping[str, Any],
        *,
        pairs: Sequence[Pair] = (),
        about: About | None = None,
        fresh: bool = False,
    ) -> None:
        path, lock = directory / FILE_NAME, directory / LOCK_NAME
        self._unsaved_records: dict[int, str] = {}
        self._unsaved_points: dict[tuple[int, str], bytes] = {}
        self._unsaved_drops: set[int] = set()
        self._asked = len(pairs)
        self._drawn: dict[int, int] = {}  # the inliers of the settled pairs that keep their points
        with ExitStack() as opened, writing(f"the work directory {directory}"):  # left open where all is well
            directory.mkdir(parents=True, exist_ok=True)
            self._lock = opened.enter_context(closing(connect(lock)))
            with undamaged(lock, "remove it"):
                self._lock.execute("BEGIN EXCLUSIVE")  # another file: a journal can be read while its run works
            if fresh:
                for ending in ("", "-journal", "-wal", "-shm"):
                    path.with_name(FILE_NAME + ending).unlink(missing_ok=True)
            super().__init__(path, opened.enter_context(closing(connect(path))))
            with undamaged(path):
                self._claim(belongs_to, pairs, about or About())
            opened.pop_all()

    def forget_changed(self, pairs: Sequence[Pair]) -> int:
        """Forget the pairs of which an image has not the content any more that was matched; how many these are.

        Where such an image was in a scene, all pairs of its batch are forgotten, and the scene: those that had all
        they wanted have no points any more to reconstruct it from.
        """
        same, batches = cache(is_unchanged), {scene.batch for scene in self.scenes()}
        with undamaged(self.path), self._db:
            self._db.execute("BEGIN")
            records = self.records().values()
            if any(not 0 <= record.index < len(pairs) for record in records):
                raise LookupError("it has pairs that the test set has not")
            changed = {r.index for r in records if not all(map(same, pairs[r.index].images, r.versions))}
            outdated = {pairs[index].group for index in changed} & batches
            forgotten = changed | {index for index, pair in enumerate(pairs) if pair.group in outdated}
            self._db.executemany("DELETE FROM pair WHERE key = ?", [[index] for index in forgotten])
            self._db.executemany("DELETE FROM points WHERE pair = ?", [[index] for index in forgotten])
            self._db.executemany("DELETE FROM scene WHERE key = ?", [[batch] for batch in outdated])
        return len(forgotten)

    def save(self, outcomes: Sequence[tuple[Outcome, bool]]) -> None:
        """Put down a job's outcomes, all or none; the points of those marked True no later job needs.

        Of these, the weakest keep them for the report: at most :data:`DRAWN` of one run. An outcome's results
        may be the new ones alone: what was put down of others stays.
        """
        self._unsaved_records |= {outcome.record.index: encode(outcome.record) for outcome, _ in outcomes}
        for outcome, settled in outcomes:
            if settled:
                self._settle(outcome.record)
            for result in outcome.results if not settled or outcome.record.index in self._drawn else ():
                self._unsaved_points[outcome.record.index, result.unit.name] = to_blob(result.matches)
        self._write()

    def save_scene(
        self, scene: SceneRecord, records: Iterable[PairRecord], settled: Iterable[PairRecord] = ()
    ) -> None:
        """Put down what came of a batch, and its pairs' records; those ``settled`` need no points any more."""
        self._unsaved_records |= {record.index: encode(record) for record in records}
        for record in settled:
            self._settle(record)
        self._write("REPLACE INTO scene VALUES (?, ?)", [scene.batch, encode(scene)])

    def note(self, kind: str, seconds: float, text: str) -> None:
        """Put down what happened, ``seconds`` after the start; ``kind`` is an :class:`EventKind`.

        Notes explain a run and must not end it: where the journal cannot be written, they are lost.
        """
        with suppress(sqlite3.Error):
            self._db.execute("INSERT INTO event (value) VALUES (?)", [encode(Event(kind, seconds, text))])

    def close(self) -> None:
        with suppress(sqlite3.Error):  # a reader may be at it: then it stays as it is
            self._db.execute("PRAGMA journal_mode = DELETE")  # one file again, which can be copied
        super().close()
        self._lock.close()

    def _points(self, index: int) -> dict[str, bytes]:
        unsaved = {unit: points for (pair, unit), points in self._unsaved_points.items() if pair == index}
        return super()._points(index) | unsaved

    def _settle(self, record: PairRecord) -> None:
        """Enter a pair among the weakest so far; the strongest of them gives up its place and its points."""
        if self._asked and record.index >= self._asked:  # no row names it, so the report does not draw it
            self._unsaved_drops.add(record.index)
            return
        self._drawn[record.index] = record.inliers
        if len(self._drawn) > DRAWN:
            strongest = max(self._drawn, key=lambda index: (self._drawn[index], index))
            del self._drawn[strongest]
            self._unsaved_drops.add(strongest)

    def _write(self, statement: str = "", values: Sequence[str] = ()) -> None:
        """Write what is not saved yet, and execute a statement, in one transaction."""
        points = [(*key, blob) for key, blob in self._unsaved_points.items() if key[0] not in self._unsaved_drops]
        with self._db:
            self._db.execute("BEGIN")
            self._db.executemany("REPLACE INTO pair VALUES (?, ?)", self._unsaved_records.items())
            self._db.executemany("REPLACE INTO points VALUES (?, ?, ?)", points)
            self._db.executemany("DELETE FROM points WHERE pair = ?", [[index] for index in self._unsaved_drops])
            self._db.execute(statement, values)
        self._unsaved_records, self._unsaved_points, self._unsaved_drops = {}, {}, set()

    def _claim(self, belongs_to: Mapping[str, Any], pairs: Sequence[Pair], about: About) -> None:
        """Write down what the journal belongs to, or compare it with what stands there."""
        is_new = self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'run'").fetchone() is None
        header = {"format": FORMAT, **belongs_to, "about": about}
        if not is_new:
            stored, wanted = self._header(), json.loads(json.dumps(belongs_to))
            if other := [key for key in wanted if stored.get(key) != wanted[key]]:
                raise UserError(
                    f"{self.path} belongs to another run: its {' and '.join(other)} differ. "
                    "Start anew with --fresh, or name another --work-dir."
                )
        # Readers do not hold up the writer then. Killed, no result is lost; with the power, the last ones.
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = NORMAL")
        with self._db:
            self._db.execute("BEGIN")
            for statement in SCHEMA.split(";")[:-1] if is_new else ():
                self._db.execute(statement)
            rows = ((key, encode(value)) for key, value in header.items())
            self._db.executemany("REPLACE INTO run VALUES (?, ?)", rows)
            if is_new:
                names = ((index, encode((p.id, p.group, *p.names))) for index, p in enumerate(pairs))
                self._db.executemany("INSERT INTO sample VALUES (?, ?)", names)


def connect(path: Path) -> sqlite3.Connection:
    """Open a database to write; raises :class:`UserError` where that cannot be."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a regular file; remove it, or name another --work-dir")
    with undamaged(path):
        return sqlite3.connect(path, timeout=1.0, isolation_level=None)
