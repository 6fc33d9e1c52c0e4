"""The durable record of a run: an SQLite file that only the parent writes, one transaction a job.

Tables: ``run`` (what the journal belongs to), ``pair`` (F, failure, seconds, inliers before an upgrade), ``unit``
(counts and seconds of each unit on each pair, and its points while a later pass may build on them), ``region``
(the critical regions), ``event`` (what happened when, in seconds since the start of the run that wrote it).
"""

import json
import sqlite3
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline import UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.run.jobs import Outcome, Record, UnitRecord

FORMAT = 2
FILE_NAME = "journal.sqlite"

_SCHEMA = """
CREATE TABLE IF NOT EXISTS run (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS pair (
    pair INTEGER PRIMARY KEY, fundamental BLOB NOT NULL, failure TEXT NOT NULL,
    decode_seconds REAL, cluster_seconds REAL, estimate_seconds REAL, before INTEGER);
CREATE TABLE IF NOT EXISTS unit (
    pair INTEGER, unit TEXT, stage INTEGER, matches INTEGER, inliers INTEGER,
    encode_seconds REAL, match_seconds REAL, failure TEXT, place INTEGER, points BLOB,
    PRIMARY KEY (pair, unit));
CREATE TABLE IF NOT EXISTS region (
    pair INTEGER, image INTEGER, "left" INTEGER, top INTEGER, "right" INTEGER, bottom INTEGER,
    reason TEXT, clusters INTEGER, kept INTEGER, PRIMARY KEY (pair, image));
CREATE TABLE IF NOT EXISTS event (place INTEGER PRIMARY KEY, kind TEXT, seconds REAL, text TEXT);
"""


class Journal:
    """The journal of a work directory, made if it is not there, held exclusively while it is open.

    ``belongs_to`` says by name what the run computes (recipe, test set, weights). Raises :class:`UserError`
    where the directory cannot be written, another run holds it, or it belongs to something else.
    """

    def __init__(self, directory: Path, belongs_to: Mapping[str, Any], *, fresh: bool = False) -> None:
        self.path = directory / FILE_NAME
        try:
            directory.mkdir(parents=True, exist_ok=True)
            if fresh:
                self.path.unlink(missing_ok=True)
                self.path.with_name(f"{FILE_NAME}-journal").unlink(missing_ok=True)
            self._db = sqlite3.connect(self.path, timeout=1.0, isolation_level=None)
            self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._db.execute("BEGIN EXCLUSIVE")
            self._db.execute("COMMIT")
            self._db.executescript(_SCHEMA)
        except OSError as error:
            raise UserError(f"the work directory {directory} cannot be written: {error.strerror}") from error
        except sqlite3.OperationalError as error:
            raise UserError(f"{self.path} cannot be used: {error}; is another run at work there?") from error
        except sqlite3.DatabaseError as error:
            raise UserError(f"{self.path} is damaged ({error}); start anew with --fresh") from error
        self._claim({"format": FORMAT, **belongs_to})

    def records(self) -> dict[int, Record]:
        """All records by pair index."""
        units: dict[int, list[UnitRecord]] = {}
        columns = "pair, unit, stage, matches, inliers, encode_seconds, match_seconds, failure"
        for pair, *values in self._db.execute(f"SELECT {columns} FROM unit ORDER BY pair, place"):
            units.setdefault(pair, []).append(UnitRecord(*values))
        regions: dict[int, list[CriticalRegion]] = {}
        columns = 'pair, "left", top, "right", bottom, reason, clusters, kept'
        for pair, left, top, right, bottom, reason, *counts in self._db.execute(
            f"SELECT {columns} FROM region ORDER BY pair, image"
        ):
            region = CriticalRegion(Box(left, top, right, bottom), RegionReason(reason), *counts)
            regions.setdefault(pair, []).append(region)
        columns = "pair, fundamental, failure, decode_seconds, cluster_seconds, estimate_seconds, before"
        return {
            pair: Record(
                pair,
                np.frombuffer(F, np.float64).reshape(3, 3),
                failure,
                tuple(units.get(pair, ())),
                (regions[pair][0], regions[pair][1]) if pair in regions else None,
                *seconds,
            )
            for pair, F, failure, *seconds in self._db.execute(f"SELECT {columns} FROM pair")
        }

    def results(self, pair: int, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        """What the units found on a pair, for a later job to build on; ``units`` by name."""
        columns = "unit, points, encode_seconds, match_seconds, failure"
        return tuple(
            UnitResult(units[name], _matches(points), encode, match, failure)
            for name, points, encode, match, failure in self._db.execute(
                f"SELECT {columns} FROM unit WHERE pair = ? ORDER BY place", [pair]
            )
        )

    def note(self, kind: str, seconds: float, text: str) -> None:
        """Put down an event, ``seconds`` after the run's start."""
        self._db.execute("INSERT INTO event (kind, seconds, text) VALUES (?, ?, ?)", [kind, seconds, text])

    def save(self, outcomes: list[tuple[Outcome, bool]]) -> None:
        """Put down a job's outcomes, all or none; the points of those marked True are not needed again.

        An outcome's results may be the new ones alone: what was put down of others stays.
        """
        with self._db:
            self._db.execute("BEGIN")
            for outcome, settled in outcomes:
                self._save(outcome, settled)

    def close(self) -> None:
        self._db.close()

    def _save(self, outcome: Outcome, settled: bool) -> None:
        record = outcome.record
        self._db.execute(
            "REPLACE INTO pair VALUES (?, ?, ?, ?, ?, ?, ?)",
            [
                record.index,
                np.ascontiguousarray(record.F, np.float64).tobytes(),
                record.failure,
                record.decode_seconds,
                record.cluster_seconds,
                record.estimate_seconds,
                record.before,
            ],
        )
        points = {} if settled else {result.unit.name: _blob(result.matches) for result in outcome.results}
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
                    unit.failure,
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

    def _claim(self, belongs_to: Mapping[str, Any]) -> None:
        """Write down what the journal belongs to, or hold it against what stands there."""
        told = {key: json.dumps(value, sort_keys=True) for key, value in belongs_to.items()}
        stored = dict(self._db.execute("SELECT key, value FROM run"))
        if not stored:
            with self._db:
                self._db.execute("BEGIN")
                self._db.executemany("INSERT INTO run VALUES (?, ?)", told.items())
            return
        other = [key for key in told if stored.get(key) != told[key]]
        if other:
            self.close()
            raise UserError(
                f"{self.path} belongs to another run: its {' and '.join(other)} differ. "
                "Start anew with --fresh, or name another --work-dir."
            )


def _blob(matches: Matches) -> bytes:
    """All float32 values, column by column, first bytes first: those of like size are alike, and deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def _matches(blob: bytes | None) -> Matches:
    planes = np.frombuffer(zlib.decompress(blob) if blob else b"", np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])
