"""The durable record of a run: an SQLite file that only the parent writes, a transaction for each job.

A value is a JSON text (see :mod:`mkpc_kaggle.engine.codec`). Tables: ``run`` (what the journal belongs to and who
wrote it), ``sample`` (ids and images of the pairs), ``pair`` (a :class:`PairRecord` for each pair that was
reached), ``points`` (of a unit on a pair: later jobs, scenes and the report need them), ``scene`` (a
:class:`SceneRecord` for each batch), ``event`` (what happened when), ``task`` (what is known of images before
there are pairs).
"""

import json
import os
import shutil
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Self

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import is_unchanged
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.codec import decoder, encode, from_blob, to_blob
from mkpc_kaggle.engine.jobs import Outcome
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit

FORMAT = 11
FILE_NAME = "journal.sqlite"
LOCK_NAME = "journal.lock"

SCHEMA = """
CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE sample (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE pair (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE points (pair INTEGER, unit TEXT, points BLOB NOT NULL, PRIMARY KEY (pair, unit));
CREATE TABLE scene (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE event (key INTEGER PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE task (key TEXT PRIMARY KEY, value BLOB NOT NULL);
"""

Row = tuple[str, tuple[Any, ...]]  # the table, and the values of its columns

# SQLite's primary result codes that say nothing against a file: no permission, busy, locked, read only, input or
# output failed, full, cannot be opened.
UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
# What reading raises where something stands that no run writes.
DAMAGE = (
    *(sqlite3.Error, zlib.error, ValueError, TypeError),
    *(LookupError, AttributeError, ArithmeticError, RecursionError),
)


class EventKind(StrEnum):
    """What is noted during a run."""

    START = "start"  # the program began to work on the run, anew or once more
    PLAN = "plan"  # a decision, and why
    JOB = "job"  # a job has ended; the text begins with its phase
    SCENE = "scene"  # a batch was reconstructed; the text says how much of it
    FAULT = "fault"
    END = "end"  # the run ended; the text says how


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


@dataclass(frozen=True)
class About:
    """Who wrote a journal last: for reports, and compared with nothing."""

    recipe: str = "unnamed"
    device: str = ""
    limit: float | None = None  # in seconds; None: there was none
    left_out: tuple[str, ...] = ()  # which matchers did not run, by cause
    versions: Mapping[str, str] = field(default_factory=dict)  # of the package and what it stands on
    estimation: str = "{}"  # how F and cameras are made of the points: JSON of :meth:`Recipe.estimation`


@contextmanager
def undamaged(path: Path, advice: str = "start anew with --fresh") -> Iterator[None]:
    """Raises :class:`UserError` where what is read of a journal is not what was written, or cannot be read now."""
    try:
        yield
    except DAMAGE as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run at work there?") from error
        raise UserError(f"{path} is damaged ({error}); {advice}") from error


class JournalReader:
    """The journal of a work directory as it is now, unchanged while it is read; a run may be at work on it.

    Raises :class:`UserError` where there is none, none that this version can read, or something is damaged.
    """

    path: Path
    _db: sqlite3.Connection

    def __init__(self, directory: Path) -> None:
        path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # A directory that cannot be written has no room for SQLite's locks, and needs none.
        mode = "mode=ro" if os.access(directory, os.W_OK) else "mode=ro&immutable=1"
        with ExitStack() as opened, undamaged(path):
            uri = f"{path.resolve().as_uri()}?{mode}"
            db = opened.enter_context(closing(sqlite3.connect(uri, uri=True, timeout=5.0, isolation_level=None)))
            db.execute("BEGIN")
            self.path, self._db = path, db
            self._header()
            opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()

    def records(self) -> dict[int, PairRecord]:
        return {record.index: record for record in self._read("pair", PairRecord)}

    def scenes(self) -> tuple[SceneRecord, ...]:
        return tuple(self._read("scene", SceneRecord))

    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of the run, in order; of the images the journal knows the names of the files alone."""
        return tuple(Pair(*names) for names in self._read("sample", tuple[str, str, str, str]))

    def tasks(self) -> set[str]:
        """The keys of the tasks that were done; see :mod:`mkpc_kaggle.engine.tasks`."""
        with undamaged(self.path):
            return {str(key) for (key,) in self._db.execute("SELECT key FROM task")}

    def task(self, key: str) -> bytes:
        """The answer of a task that was done, else nothing."""
        with undamaged(self.path):
            found = self._db.execute("SELECT value FROM task WHERE key = ?", [key]).fetchone()
        return bytes(found[0]) if found else b""

    def events(self) -> tuple[Event, ...]:
        """All events of all sessions of the run, in order."""
        return tuple(self._read("event", Event))

    def about(self) -> About:
        with undamaged(self.path):
            about: About = decoder(About)(self._header()["about"])
            return about

    def belongs_to(self) -> dict[str, Any]:
        """What the run matches, by name: the recipe's part in it, digests of the test set and the weights."""
        return {key: value for key, value in self._header().items() if key not in ("format", "about")}

    def results(self, record: PairRecord, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]:
        """What the units of a record found, for a later job to build on; ``units`` by name."""
        with undamaged(self.path):
            points = self._points(record.index)
            had = ((each, from_blob(points.get(each.unit))) for each in record.units)
            return tuple(each.result(units[each.unit], matches) for each, matches in had)

    def _points(self, index: int) -> dict[str, bytes]:
        return dict(self._db.execute("SELECT unit, points FROM points WHERE pair = ?", [index]))

    def _read(self, table: str, kind: Any) -> list[Any]:
        with undamaged(self.path):
            decode = decoder(kind)
            rows = self._db.execute(f"SELECT value FROM {table} ORDER BY key")
            return [decode(json.loads(value)) for (value,) in rows]

    def _header(self) -> dict[str, Any]:
        """The table ``run``; raises :class:`UserError` where another version wrote it."""
        with undamaged(self.path):
            header = {key: json.loads(value) for key, value in self._db.execute("SELECT key, value FROM run")}
        if (written := header.get("format")) != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (journal format {written}, this "
                f"version has {FORMAT}). Use that version, or start anew with --fresh or another --work-dir."
            )
        return header


class Journal(JournalReader):
    """The journal of a work directory, made if it is not there; no other run can open it while this run has it.

    ``belongs_to`` says by name what the run matches (recipe, test set, weights). Raises :class:`UserError`
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
        self._unsaved: list[Row] = []
        with ExitStack() as opened, writing(f"the work directory {directory}"):  # left open where all is well
            directory.mkdir(parents=True, exist_ok=True)
            self._lock = opened.enter_context(closing(connect(lock)))
            with undamaged(lock, "remove it"):
                self._lock.execute("BEGIN EXCLUSIVE")  # another file: a journal can be read while its run works
            if fresh:
                for ending in ("", "-journal", "-wal", "-shm"):
                    path.with_name(FILE_NAME + ending).unlink(missing_ok=True)
            self.path, self._db = path, opened.enter_context(closing(connect(path)))
            with undamaged(path):
                self._claim(belongs_to, pairs, about or About())
            opened.pop_all()

    def forget_outdated(self, pairs: Sequence[Pair], *, has_scenes: bool) -> int:
        """Forget the pairs of which an image has not the content any more that was matched; how many these are.

        The scenes of their batches are forgotten, too; all scenes if the run has none. Their pairs have the F of
        their own matches again.
        """
        same = cache(is_unchanged)
        with undamaged(self.path), self._db:
            self._db.execute("BEGIN")
            known = self.records()
            if known and min(known) < 0:
                raise LookupError("it has pairs that no test set has")
            # Another run may have had more extra pairs for its scenes: the first of them are always the same.
            records = [record for index, record in known.items() if index < len(pairs)]
            changed = {r.index for r in records if not all(map(same, pairs[r.index].images, r.versions))}
            outdated = {pairs[index].group for index in (changed if has_scenes else range(len(pairs)))}
            chosen = [record for record in records if record.scene and pairs[record.index].group in outdated]
            self._put(pair_row(replace(record, scene=None)) for record in chosen)
            for statement, keys in (
                ("DELETE FROM pair WHERE key = ?", changed),
                ("DELETE FROM points WHERE pair = ?", changed),
                ("DELETE FROM scene WHERE key = ?", outdated),
            ):
                self._db.executemany(statement, [(key,) for key in keys])
        return len(changed)

    def save(self, outcomes: Iterable[Outcome]) -> None:
        """Put down a job's outcomes, all or none.

        An outcome may have the new results alone: what was put down of others stays.
        """
        rows: list[Row] = []
        for outcome in outcomes:
            rows.append(pair_row(outcome.record))
            for found in outcome.results:
                rows.append(("points", (outcome.record.index, found.unit.name, to_blob(found.matches))))
        self._write(rows)

    def save_scene(self, scene: SceneRecord, records: Iterable[PairRecord]) -> None:
        self._write([*map(pair_row, records), ("scene", (scene.batch, encode(scene)))])

    def save_task(self, key: str, value: bytes) -> None:
        self._write([("task", (key, value))])

    def task(self, key: str) -> bytes:
        return dict(self._unsaved_in("task")).get(key) or super().task(key)

    def note(self, event: Event) -> None:
        """Put down what happened; it is lost where the journal cannot be written, and the run goes on."""
        with suppress(sqlite3.Error):
            self._db.execute("INSERT INTO event (value) VALUES (?)", [encode(event)])

    def close(self) -> None:
        with suppress(sqlite3.Error):  # a reader may be at it: then it stays as it is
            self._db.execute("PRAGMA journal_mode = DELETE")  # a single file again, which can be copied
        super().close()
        self._lock.close()

    def _points(self, index: int) -> dict[str, bytes]:
        unsaved = {unit: blob for pair, unit, blob in self._unsaved_in("points") if pair == index}
        return super()._points(index) | unsaved

    def _unsaved_in(self, table: str) -> list[tuple[Any, ...]]:
        return [values for name, values in self._unsaved if name == table]

    def _write(self, rows: Iterable[Row]) -> None:
        """Write these rows and those that the file did not take before, in one transaction."""
        self._unsaved += rows
        with self._db:
            self._db.execute("BEGIN")
            self._put(self._unsaved)
        self._unsaved.clear()

    def _put(self, rows: Iterable[Row]) -> None:
        for table, values in rows:
            self._db.execute(f"REPLACE INTO {table} VALUES ({', '.join('?' * len(values))})", values)

    def _claim(self, belongs_to: Mapping[str, Any], pairs: Sequence[Pair], about: About) -> None:
        """Write down what the journal belongs to, or compare it with what stands there."""
        is_new = self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'run'").fetchone() is None
        if not is_new:
            stored, wanted = self._header(), json.loads(json.dumps(belongs_to))
            if other := [key for key in wanted if stored.get(key) != wanted[key]]:
                raise UserError(
                    f"{self.path} belongs to another run (different {', '.join(other)}). "
                    "Start anew with --fresh, or name another --work-dir."
                )
        # Readers do not hold up the writer then. Killed, no result is lost; with the power, the last results.
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = NORMAL")
        with self._db:
            self._db.execute("BEGIN")
            if is_new:
                for statement in SCHEMA.split(";")[:-1]:
                    self._db.execute(statement)
                self._put(("sample", (i, encode((p.id, p.group, *p.names)))) for i, p in enumerate(pairs))
            header = {"format": FORMAT, **belongs_to, "about": about}
            self._put(("run", (key, encode(value))) for key, value in header.items())


def pair_row(record: PairRecord) -> Row:
    return "pair", (record.index, encode(record))


def share_journal(source: Path, target: Path) -> None:
    """Let the run of a work directory begin with the journal of another that has ended, if it has none yet."""
    path = target / FILE_NAME
    if not path.exists():
        with writing(f"the work directory {target}"):
            target.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / FILE_NAME, path.with_suffix(".part"))
            path.with_suffix(".part").replace(path)


def connect(path: Path) -> sqlite3.Connection:
    """Open a database to write; raises :class:`UserError` where that cannot be."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a regular file; remove it, or name another --work-dir")
    with undamaged(path):
        return sqlite3.connect(path, timeout=1.0, isolation_level=None)
