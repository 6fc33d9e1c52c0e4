"""The durable record of a run: an SQLite file that only the parent writes, one transaction a job.

Tables: ``run`` (what the journal belongs to and who wrote it), ``sample`` (the ids of the pairs), ``pair`` (F,
failure, seconds, inliers before an upgrade), ``unit`` (counts and seconds of each unit on each pair, and its
points while a later pass may build on them or the report may draw them), ``region`` (the critical regions),
``choice`` (which F the reconstruction of its batch gives a pair, and why), ``scene`` (what came of each batch),
``event`` (what happened when).
"""

import json
import os
import sqlite3
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.records import CameraRecord, PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice, Reason

FORMAT = 3
FILE_NAME = "journal.sqlite"
LOCK_NAME = "journal.lock"
DRAWN = 10
"""How many of the weakest pairs keep their points when no later pass needs them: the report draws them."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS run (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS sample (
    pair INTEGER PRIMARY KEY, id TEXT NOT NULL, "group" TEXT NOT NULL, image0 TEXT NOT NULL, image1 TEXT NOT NULL);
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
CREATE TABLE IF NOT EXISTS choice (pair INTEGER PRIMARY KEY, fundamental BLOB, reason TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS scene (
    batch TEXT PRIMARY KEY, images INTEGER, placed INTEGER, models INTEGER, points INTEGER, seconds REAL,
    failure TEXT NOT NULL, cameras TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS event (place INTEGER PRIMARY KEY, kind TEXT, seconds REAL, text TEXT);
"""


class EventKind(StrEnum):
    """What is noted during a run."""

    START = "start"
    """the program began to work on the run, anew or once more"""
    PLAN = "plan"
    """units were given up or taken up again, and why"""
    BUDGET = "budget"
    """a job of the phase that the text names has ended"""
    JOB = "job"
    """what that job was"""
    SCENE = "scene"
    """a batch was reconstructed; the text says how much of it"""
    FAULT = "fault"
    END = "end"
    """the run ended; the text says how"""


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str


@dataclass(frozen=True)
class About:
    """Who wrote a journal last: for reports, and compared with nothing.

    ``limit`` is the time limit in seconds, ``None`` if there was none; ``left_out`` are names of units whose
    weights were missing or not permitted; ``versions`` are those of the package and what it stands on.
    """

    recipe: str = "unnamed"
    device: str = ""
    limit: float | None = None
    left_out: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


class _Tables:
    """The reading side of an open journal."""

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        self.path = path
        self._db = db

    def records(self) -> dict[int, PairRecord]:
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
        choices = {
            pair: Choice(None if F is None else _matrix(F), Reason(reason))
            for pair, F, reason in self._db.execute("SELECT pair, fundamental, reason FROM choice")
        }
        columns = "pair, fundamental, failure, decode_seconds, cluster_seconds, estimate_seconds, before"
        return {
            pair: PairRecord(
                pair,
                _matrix(F),
                failure,
                tuple(units.get(pair, ())),
                (regions[pair][0], regions[pair][1]) if pair in regions else None,
                decode,
                cluster,
                estimate,
                before,
                choices.get(pair),
            )
            for pair, F, failure, decode, cluster, estimate, before in self._db.execute(
                f"SELECT {columns} FROM pair"
            )
        }

    def scenes(self) -> tuple[SceneRecord, ...]:
        """What came of each batch that was reconstructed, by name."""
        columns = "batch, images, placed, models, points, seconds, failure"
        rows = self._db.execute(f"SELECT {columns}, cameras FROM scene ORDER BY batch")
        found = []
        for *values, cameras in rows:
            known = tuple(CameraRecord(**camera) for camera in json.loads(cameras))
            found.append(replace(SceneRecord(*values), cameras=known))
        return tuple(found)

    def results(self, pair: int, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        """What the units found on a pair, for a later job to build on; ``units`` by name."""
        columns = "unit, points, encode_seconds, match_seconds, failure"
        return tuple(
            UnitResult(units[name], _matches(points), encode, match, failure)
            for name, points, encode, match, failure in self._db.execute(
                f"SELECT {columns} FROM unit WHERE pair = ? ORDER BY place", [pair]
            )
        )


class JournalReader(_Tables):
    """The journal of a work directory as it is now, unchanged while it is read; a run may be at work on it.

    Raises :class:`UserError` where there is none, or none that this version can read.
    """

    def __init__(self, directory: Path) -> None:
        path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # A directory that cannot be written has no room for SQLite's locks, and needs none.
        mode = "mode=ro" if os.access(directory, os.W_OK) else "mode=ro&immutable=1"
        try:
            db = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True, timeout=5.0, isolation_level=None)
            db.execute("BEGIN")
            require_format(path, _header(db))
        except sqlite3.OperationalError as error:
            raise UserError(f"{path} cannot be read now ({error}); try again when its run has ended") from error
        except sqlite3.DatabaseError as error:
            raise UserError(f"{path} is damaged ({error})") from error
        super().__init__(path, db)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._db.close()

    def belongs_to(self) -> dict[str, Any]:
        """What the run computes, by name: the recipe's fingerprint, digests of the test set and the weights."""
        return {key: value for key, value in _header(self._db).items() if key not in ("format", "about")}

    def about(self) -> About:
        values = _header(self._db).get("about", {})
        return About(**{**values, "left_out": tuple(values.get("left_out", ()))})

    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of the run, in order; of the images the journal knows the names of the files alone."""
        rows = self._db.execute('SELECT id, "group", image0, image1 FROM sample ORDER BY pair')
        return tuple(Pair(id_, group, Path(image0), Path(image1)) for id_, group, image0, image1 in rows)

    def events(self) -> tuple[Event, ...]:
        """All events of all sessions of the run, in order."""
        return tuple(
            Event(*row) for row in self._db.execute("SELECT kind, seconds, text FROM event ORDER BY place")
        )


class Journal(_Tables):
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
        try:
            directory.mkdir(parents=True, exist_ok=True)
            # A lock of its own, so that the journal itself can be read while the run is at work.
            self._lock = sqlite3.connect(directory / LOCK_NAME, timeout=1.0, isolation_level=None)
            self._lock.execute("BEGIN EXCLUSIVE")
            if fresh:
                for ending in ("", "-journal", "-wal", "-shm"):
                    path.with_name(FILE_NAME + ending).unlink(missing_ok=True)
            super().__init__(path, sqlite3.connect(path, timeout=1.0, isolation_level=None))
            self._claim({"format": FORMAT, **belongs_to}, pairs, about or About())
        except OSError as error:
            raise UserError(f"the work directory {directory} cannot be written: {error.strerror}") from error
        except sqlite3.OperationalError as error:
            raise UserError(f"{path} cannot be used: {error}; is another run at work there?") from error
        except sqlite3.DatabaseError as error:
            raise UserError(f"{path} is damaged ({error}); start anew with --fresh") from error
        self._drawn: dict[int, int] = {}

    def save(self, outcomes: list[tuple[Outcome, bool]]) -> None:
        """Put down a job's outcomes, all or none; the points of those marked True no later job needs.

        Of these, the weakest keep them for the report: at most :data:`DRAWN` of one session. An outcome's results
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
        rows = [(i, None if one.F is None else one.F.tobytes(), str(one.reason)) for i, one in choices.items()]
        values = [*astuple(scene)[:-1], json.dumps([asdict(camera) for camera in scene.cameras])]
        with self._db:
            self._db.execute("BEGIN")
            self._db.executemany("REPLACE INTO choice VALUES (?, ?, ?)", rows)
            self._db.execute("REPLACE INTO scene VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)

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
            self._db.execute("INSERT INTO event (kind, seconds, text) VALUES (?, ?, ?)", [kind, seconds, text])

    def close(self) -> None:
        with suppress(sqlite3.Error):  # a reader may be at it: then it stays as it is
            self._db.execute("PRAGMA journal_mode = DELETE")  # one file again, which can be copied
        self._db.close()
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

    def _claim(self, belongs_to: Mapping[str, Any], pairs: Sequence[Pair], about: About) -> None:
        """Write down what the journal belongs to, or compare it with what stands there."""
        try:
            stored = _header(self._db)
            if stored:
                require_format(self.path, stored)
                self._require_same(stored, belongs_to)
        except UserError:
            self.close()
            raise
        # Readers do not hold up the writer then. Killed, no result is lost; with the power, the last ones.
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = NORMAL")
        with self._db:
            self._db.execute("BEGIN")
            for statement in filter(str.strip, _SCHEMA.split(";")):
                self._db.execute(statement)
            values = {**belongs_to, "about": asdict(about)}.items()
            rows = [(key, json.dumps(value, sort_keys=True)) for key, value in values]
            self._db.executemany("REPLACE INTO run VALUES (?, ?)", rows)
            if not stored:
                names = ((i, p.id, p.group, p.image0.name, p.image1.name) for i, p in enumerate(pairs))
                self._db.executemany("INSERT INTO sample VALUES (?, ?, ?, ?, ?)", names)

    def _require_same(self, stored: Mapping[str, Any], belongs_to: Mapping[str, Any]) -> None:
        wanted = json.loads(json.dumps(belongs_to))
        other = [key for key in wanted if stored.get(key) != wanted[key]]
        if other:
            raise UserError(
                f"{self.path} belongs to another run: its {' and '.join(other)} differ. "
                "Start anew with --fresh, or name another --work-dir."
            )


def require_format(path: Path, header: Mapping[str, Any]) -> None:
    """Raise :class:`UserError` unless the journal was written in this version's format."""
    written = header.get("format")
    if written != FORMAT:
        raise UserError(
            f"{path} was written by another version of this program (journal format {written}, this version has "
            f"{FORMAT}). Use that version, or start anew with --fresh or another --work-dir."
        )


def _header(db: sqlite3.Connection) -> dict[str, Any]:
    """The table ``run``; empty where the journal is new."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'run'").fetchone():
        return {}
    return {key: json.loads(value) for key, value in db.execute("SELECT key, value FROM run")}


def _matrix(blob: bytes) -> Matrix3:
    return np.frombuffer(blob, np.float64).reshape(3, 3)


def _blob(matches: Matches) -> bytes:
    """All float32 values, column by column, first bytes first: those of like size are alike, and deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def _matches(blob: bytes | None) -> Matches:
    planes = np.frombuffer(zlib.decompress(blob) if blob else b"", np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])
