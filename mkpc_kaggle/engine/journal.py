"""The durable record of a run: an SQLite file that only the parent writes, one transaction a job."""

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, astuple
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import is_unchanged, printable
from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.journal_tables import (
    DRAWN,
    FILE_NAME,
    FORMAT,
    LOCK_NAME,
    SCHEMA,
    About,
    JournalTables,
    connect,
    header_of,
    reading,
    require_format,
    to_blob,
    undamaged,
)
from mkpc_kaggle.engine.records import GIVEN_UP, PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.scene.choose import Choice


class Journal(JournalTables):
    """The journal of a work directory, made if it is not there; no other run can open it while this one has it.

    ``belongs_to`` says by name what the run computes (recipe, test set, weights). Raises :class:`UserError`
    where the directory cannot be written, another run holds it, or it belongs to something else.
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
        path = directory / FILE_NAME
        with ExitStack() as opened:  # nothing stays open where something fails
            try:
                directory.mkdir(parents=True, exist_ok=True)
                self._lock = opened.enter_context(closing(connect(directory / LOCK_NAME)))
                self._take_lock(directory / LOCK_NAME)
                if fresh:
                    for ending in ("", "-journal", "-wal", "-shm"):
                        path.with_name(FILE_NAME + ending).unlink(missing_ok=True)
            except OSError as error:
                raise UserError(f"the work directory {directory} cannot be written: {error.strerror}") from error
            super().__init__(path, opened.enter_context(closing(connect(path))))
            with undamaged(path):
                self._claim({"format": FORMAT, **belongs_to}, pairs, about or About())
            opened.pop_all()
        self._drawn: dict[int, int] = {}

    def _take_lock(self, path: Path) -> None:
        """A lock of its own, so that the journal itself can be read while the run is at work."""
        try:
            self._lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            raise UserError(f"{path} cannot be used: {error}; is another run at work there?") from error
        except sqlite3.DatabaseError as error:
            raise UserError(f"{path} is no lock of this program ({error}); remove it") from error

    @reading
    def forget_changed(self, pairs: Sequence[Pair]) -> int:
        """Forget the pairs of which an image has not the content any more that was matched; how many these are.

        Where such an image was in a scene, all pairs of its batch are forgotten, and the scene: those that had all
        they wanted have no points any more to reconstruct it from.
        """
        same = cache(is_unchanged)
        records = self.records()
        if any(not 0 <= index < len(pairs) for index in records):
            raise LookupError("it has pairs that the test set has not")
        changed = {
            index for index, record in records.items() if not all(map(same, pairs[index].images, record.versions))
        }
        scenes = {pairs[index].group for index in changed} & {scene.batch for scene in self.scenes()}
        forgotten = changed | {index for index, pair in enumerate(pairs) if pair.group in scenes}
        with self._db:
            self._db.execute("BEGIN")
            for table in ("pair", "unit", "region", "choice"):
                self._db.executemany(f"DELETE FROM {table} WHERE pair = ?", [[index] for index in forgotten])
            self._db.executemany("DELETE FROM scene WHERE batch = ?", [[batch] for batch in scenes])
        return len(forgotten)

    def forget_given_up(self) -> None:
        """Forget that units were given up on pairs: they are tried again; a pair that has had no other is new."""
        with self._db:
            self._db.execute("BEGIN")
            self._db.execute("DELETE FROM unit WHERE substr(failure, 1, ?) = ?", [len(GIVEN_UP), GIVEN_UP])
            self._db.execute("DELETE FROM pair WHERE pair NOT IN (SELECT pair FROM unit)")

    def save(self, outcomes: list[tuple[Outcome, bool]]) -> None:
        """Put down a job's outcomes, all or none; the points of those marked True no later job needs.

        Of these, the weakest keep them for the report: at most :data:`DRAWN` of one run. An outcome's results
        may be the new ones alone: what was put down of others stays.
        """
        drawn = dict(self._drawn)
        with self._db:
            self._db.execute("BEGIN")
            for outcome, settled in outcomes:
                stronger = self._enter(outcome.record, drawn) if settled and outcome.results else None
                self._save(outcome, settled and (not outcome.results or stronger == outcome.record.index))
                if stronger is not None:
                    self._drop_points(stronger)
        self._drawn = drawn

    def save_scene(self, scene: SceneRecord, choices: Mapping[int, Choice]) -> None:
        """Put down what came of a batch, and which F its pairs get, by their places."""
        rows = [(index, _blob(choice.F), str(choice.reason)) for index, choice in choices.items()]
        drawn = json.dumps([asdict(camera) for camera in scene.cameras]), json.dumps(scene.cloud)
        *values, failure = astuple(scene)[:-2]
        values = [*values, printable(failure), *drawn]
        with self._db:
            self._db.execute("BEGIN")
            self._db.executemany("REPLACE INTO choice VALUES (?, ?, ?)", rows)
            self._db.execute("REPLACE INTO scene VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)

    def settle(self, records: Iterable[PairRecord]) -> None:
        """Drop the points of pairs that no later job or scene needs; the weakest keep theirs for the report."""
        drawn = dict(self._drawn)
        with self._db:
            self._db.execute("BEGIN")
            for record in records:
                stronger = self._enter(record, drawn)
                if stronger is not None:
                    self._drop_points(stronger)
        self._drawn = drawn

    def note(self, kind: str, seconds: float, text: str) -> None:
        """Put down what happened, ``seconds`` after the start; ``kind`` is an :class:`EventKind`.

        Notes explain a run and must not end it: where the journal cannot be written, they are lost.
        """
        with suppress(sqlite3.Error):
            self._db.execute(
                "INSERT INTO event (kind, seconds, text) VALUES (?, ?, ?)", [kind, seconds, printable(text)]
            )

    def close(self) -> None:
        with suppress(sqlite3.Error):  # a reader may be at it: then it stays as it is
            self._db.execute("PRAGMA journal_mode = DELETE")  # one file again, which can be copied
        super().close()
        self._lock.close()

    def _enter(self, record: PairRecord, drawn: dict[int, int]) -> int | None:
        """Enter a settled pair among the weakest so far; the pair that is too strong to be among them, if any."""
        drawn[record.index] = record.inliers
        if len(drawn) <= DRAWN:
            return None
        strongest = max(drawn, key=lambda index: (drawn[index], index))
        del drawn[strongest]
        return strongest

    def _drop_points(self, index: int) -> None:
        self._db.execute("UPDATE unit SET points = NULL WHERE pair = ?", [index])

    def _save(self, outcome: Outcome, settled: bool) -> None:
        record = outcome.record
        self._db.execute(
            "REPLACE INTO pair VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                record.index,
                _blob(record.pair_fundamental),
                printable(record.failure),
                record.decode_seconds,
                record.cluster_seconds,
                record.estimate_seconds,
                *(record.versions or ("", "")),
                *([side for size in record.sizes for side in size] or (None,) * 4),
                _blob(record.magsac_fundamental),
            ],
        )
        points = {} if settled else {result.unit.name: to_blob(result.matches) for result in outcome.results}
        if settled:
            self._db.execute("UPDATE unit SET points = NULL WHERE pair = ?", [record.index])
        self._db.executemany(
            "INSERT INTO unit VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET "
            "matches = excluded.matches, inliers = excluded.inliers, encode_seconds = excluded.encode_seconds, "
            "match_seconds = excluded.match_seconds, failure = excluded.failure, place = excluded.place, "
            "points = coalesce(excluded.points, points)",
            [
                [
                    record.index,
                    unit.unit,
                    unit.stage,
                    unit.matches,
                    unit.inliers,
                    unit.encode_seconds,
                    unit.match_seconds,
                    printable(unit.failure),
                    place,
                    points.get(unit.unit),
                ]
                for place, unit in enumerate(record.units)
            ],
        )
        self._db.executemany(
            "REPLACE INTO region VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                [
                    record.index,
                    image,
                    region.box.left,
                    region.box.top,
                    region.box.right,
                    region.box.bottom,
                    region.reason,
                    region.clusters,
                    region.kept,
                ]
                for image, region in enumerate(record.regions or ())
            ],
        )

    def _claim(self, belongs_to: Mapping[str, Any], pairs: Sequence[Pair], about: About) -> None:
        """Write down what the journal belongs to, or compare it with what stands there."""
        stored = header_of(self._db)
        if stored:
            require_format(self.path, stored)
            self._require_same(stored, belongs_to)
        # Readers do not hold up the writer then. Killed, no result is lost; with the power, the last ones.
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = NORMAL")
        with self._db:
            self._db.execute("BEGIN")
            for statement in SCHEMA.split(";")[:-1] if not stored else ():
                self._db.execute(statement)
            values = {**belongs_to, "about": asdict(about)}.items()
            rows = [(key, json.dumps(value, sort_keys=True)) for key, value in values]
            self._db.executemany("REPLACE INTO run VALUES (?, ?)", rows)
            if not stored:
                names = ((i, p.id, p.group, *p.names) for i, p in enumerate(pairs))
                self._db.executemany("INSERT INTO sample VALUES (?, ?, ?, ?, ?)", names)

    def _require_same(self, stored: Mapping[str, Any], belongs_to: Mapping[str, Any]) -> None:
        wanted = json.loads(json.dumps(belongs_to))
        other = [key for key in wanted if stored.get(key) != wanted[key]]
        if other:
            raise UserError(
                f"{self.path} belongs to another run: its {' and '.join(other)} differ. "
                "Start anew with --fresh, or name another --work-dir."
            )


def _blob(matrix: Matrix3 | None) -> bytes | None:
    return None if matrix is None else np.ascontiguousarray(matrix, np.float64).tobytes()
