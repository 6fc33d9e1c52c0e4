"""The store of a run: an SQLite file that has each result under the digest of its inputs.

There is one table. ``about`` is JSON, all that reports need; ``data`` are a unit's points. Results
under unused keys stay until they are pruned or the run starts with --fresh. The parent alone
writes, one transaction for each answer. It reads the store once, at its start, and keeps its state
in memory (:mod:`mkpc_kaggle.engine.plan.state`).
"""

import errno
import json
import os
import shutil
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, Self

import numpy as np

from mkpc_kaggle.errors import UserError, plural, printable, warn_once, writing
from mkpc_kaggle.geometry.matches import Matches

FORMAT = 21  # increase it when a kind of result is stored differently: nothing is converted
FILE_NAME = "journal.sqlite"  # named in the documentation, and in scripts of users
LOCK_NAME = "journal.lock"
# STRICT refuses values of a wrong type, and json_valid refuses numbers that are not JSON, such as NaN.
# Both would be noticed only when a report is made.
SCHEMA = """
CREATE TABLE result (
    key TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    about TEXT NOT NULL CHECK (json_valid(about)),
    data BLOB NOT NULL,
    digest BLOB NOT NULL
) STRICT
"""
DIGEST_BYTES = 4  # of each part of a row; the column has two of them, of about and of data
MIN_SQLITE = (3, 37, 0)  # STRICT tables
MAX_KEYS = 500  # in a query; SQLite allows 999 values

# SQLite's primary result codes. Only CORRUPT means damage, for which the advice is to delete the file:
# wrong advice costs the user hours of results.
CORRUPT = {11, 26}  # a malformed file, and a file that is no database
UNUSABLE = {3, 5, 6, 8, 14}  # no permission, busy, locked, read only, cannot be opened
CANNOT_OPEN = 14
BUSY = {5, 6}  # another program has a lock

LATEST_BYTES = 8 << 20  # twice the log, which SQLite copies to the file at 1,000 pages
RETRY_S = 30.0  # between tries to write results that the file did not take
# For the lock of another program, while the loop waits
BUSY_TIMEOUT_MS = 100


class Kind(StrEnum):
    """Kinds of results. Only the first three can be pruned."""

    POINTS = "points"  # of a unit on a pair
    ESTIMATE = "estimate"  # of a pair
    SCENE = "scene"  # of a batch
    FEATURES = "features"  # of an image, or of the images of a folder
    IMAGE = "image"  # a file's digest by its name, or facts about a content
    EXPORT = "export"  # the scene whose files a directory has, by batch
    EVENT = "event"
    TABLE = "table"


# The other kinds are small, or no table of pairs names them.
PRUNED = (Kind.POINTS, Kind.ESTIMATE, Kind.SCENE)


@dataclass(frozen=True, eq=False)
class Result:
    """A row of the store. ``about`` is a JSON value."""

    key: str
    kind: Kind
    about: Any
    data: bytes = b""


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Convert SQLite's report of a damaged file, or of one that cannot be used, to a
    :class:`UserError`.

    Everything else is a fault of the machine or of the program, and stays as it is.
    """
    try:
        yield
    except sqlite3.DatabaseError as error:
        # The low byte is the primary code; the higher bytes are details of it.
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in UNUSABLE:
            text = f"{path} cannot be used: {error}; is another run using it?"
            raise UserError(text) from error
        if code in CORRUPT:
            raise UserError(f"{path} is damaged ({error}); {advice}") from error
        raise


class Store:
    """The store of a work directory. :meth:`open` gives one to write, :meth:`read` a snapshot."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.path = directory / FILE_NAME
        self.trouble = ""  # a sentence on what keeps the file from having all results, if anything
        self.damaged: set[str] = set()  # keys of rows that do not fit their digest
        self._has_file = True  # false if the disk was full already at the start
        self._is_damaged = False  # by another program, since the file was opened
        self._identity: tuple[int, int] | None = None  # of the open file
        self._unsaved: dict[str, Result] = {}  # results that the file did not take
        self._latest: dict[str, int] = {}  # keys and bytes of the latest results in the file
        self._retry_at = 0.0  # when they are tried again, on the monotonic clock
        self._db = closed_connection()
        self._lock: sqlite3.Connection | None = None
        self._closing = ExitStack()  # a copy to remove

    @classmethod
    def open(cls, directory: Path, *, fresh: bool = False) -> Self:
        """Return a store to write, created if missing. No other run can open it at the same time.

        Raises :class:`UserError` if the directory is not writable or in use, and for a damaged file
        or a file of an earlier format.
        """
        if sqlite3.sqlite_version_info < MIN_SQLITE:
            raise UserError(
                f"SQLite {sqlite3.sqlite_version} is too old: Python needs 3.37 or newer for the store"
            )
        store = cls(directory)
        with ExitStack() as opened, writing(f"the work directory {directory}"):
            directory.mkdir(parents=True, exist_ok=True)
            lock = directory / LOCK_NAME
            for path in (lock, store.path):
                if path.exists() and not path.is_file():
                    raise UserError(
                        f"{path} is not a regular file; remove it, or name another --work-dir"
                    )
            store._take_lock(lock, opened)
            if fresh:
                # A write-ahead log of a former file would be applied to the new one.
                for ending in ("", "-journal", "-wal", "-shm"):
                    directory.joinpath(FILE_NAME + ending).unlink(missing_ok=True)
            with undamaged(store.path):
                store._open_file(opened)
                store._remove_damaged_rows()
            opened.pop_all()  # all is open: nothing is closed on leaving
        return store

    @classmethod
    def read(cls, directory: Path, *, check: bool = True) -> Self:
        """Return a snapshot of a store, even while a run writes to it.

        Raises :class:`UserError` if the file is missing, damaged, or of another format.
        """
        store = cls(directory)
        if not store.path.is_file():
            name = f"{directory} has no {FILE_NAME}"
            raise UserError(f"{name}: name the work directory of a run (NAME.work)")
        path = store.path
        # The last connection removes SQLite's other files, which a read-only one would leave.
        mode = "mode=rw"
        with ExitStack() as opened, undamaged(path):
            # SQLite cannot create its locks in a read-only directory, and needs none there.
            if not os.access(directory, os.W_OK):
                mode = "mode=ro&immutable=1"
                path = _with_its_log(path, opened)
            store._db = opened.enter_context(closing(connected(path, mode, timeout=5.0)))
            store._db.execute("PRAGMA query_only = ON")
            # One transaction for all reads: the run may publish meanwhile.
            store._db.execute("BEGIN")
            if check:
                store._check()
            store._closing = opened.pop_all()
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._lock is not None:
            self.flush()
            if self._is_damaged:
                self._close_without_checkpoint()
            else:
                with suppress(sqlite3.Error):  # a full disk
                    # If no reader uses the file, closing leaves a single file, to copy.
                    self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._lock.close()
        self._db.close()
        self._closing.close()

    def _close_without_checkpoint(self) -> None:
        """Close the file, and leave its log as it is.

        Pages that another program has overwritten must not get into the file: the next run reads
        the part of the log that is whole.
        """
        with suppress(sqlite3.Error), closing(connected(self.path, "mode=ro")) as reader:
            # While this connection has the file open, the other one is not the last, which would
            # copy the log; and this one cannot write.
            reader.execute("SELECT 1 FROM sqlite_master").fetchone()
            self._db.close()

    # Writing

    def put(self, results: Iterable[Result]) -> None:
        """Save results, all or none. Results that the file does not take wait in memory.

        Raises ``sqlite3.IntegrityError`` for results that the table cannot hold, such as a number
        that is NaN.
        """
        new = {result.key: result for result in results}
        # A value that the table cannot hold must be refused now, and not when it is written later.
        rows = [_row(each) for each in new.values()]
        self._note_place()
        if self._is_damaged or (self._unsaved and monotonic() < self._retry_at):
            self._check_values(rows)
            self._unsaved |= new
            return
        # Waiting results are tried again: the disk may have room, or the lock may be free.
        rows = [_row(each) for each in self._unsaved.values() if each.key not in new] + rows
        if not rows:
            return
        try:
            with self._db:
                self._db.execute("BEGIN IMMEDIATE")
                # REPLACE: a table of pairs and the facts of a file have the same key each time.
                self._db.executemany("REPLACE INTO result VALUES (?, ?, ?, ?, ?)", rows)
        except sqlite3.IntegrityError:
            raise
        except sqlite3.DatabaseError as error:  # a full disk, a lock, a damaged file
            if not self._note_damage(error):
                self.trouble = f"the journal cannot be written ({error}); results stay in memory"
            self._unsaved |= new
            # Not with each answer, because waiting for a lock and writing many rows take time.
            self._retry_at = monotonic() + RETRY_S
        else:
            self.damaged -= new.keys()
            self._unsaved = {}
            self._note_written(rows)

    def flush(self) -> str:
        """Try to write the results that wait in memory. Return why the file does not have all
        results, or an empty text.
        """
        self._retry_at = 0.0
        self.put([])
        self._check_latest()
        is_whole = self._has_file and not self._is_damaged and self._is_in_place
        if is_whole and not self._unsaved:
            self.trouble = ""  # a lock, or a disk that has room again
        return self.trouble

    def _note_written(self, rows: Iterable[tuple[str, str, str, bytes, bytes]]) -> None:
        for key, _, about, data, _ in rows:
            self._latest[key] = len(about) + len(data)
        while sum(self._latest.values()) > LATEST_BYTES:
            del self._latest[next(iter(self._latest))]

    def _check_latest(self) -> None:
        """Read the latest results again, as they are in the log. SQLite copies the log to the file
        unread, with all that another program has written there.
        """
        if not self._latest or not self._has_file or self._is_damaged or not self._is_in_place:
            return
        marks = ", ".join("?" * MAX_KEYS)
        query = f"SELECT key, kind, about, data, digest FROM result WHERE key IN ({marks})"
        keys = list(self._latest)
        # Another connection, which has no page in memory
        try:
            with closing(connected(self.path, "mode=ro")) as reader:
                for start in range(0, len(keys), MAX_KEYS):
                    part = keys[start : start + MAX_KEYS]
                    part += part[:1] * (MAX_KEYS - len(part))
                    for key, kind, about, data, digest in reader.execute(query, part):
                        if digest != _digest(key, kind, about) + _digest(key, kind, data):
                            raise sqlite3.DatabaseError("a result does not fit its digest")
        except sqlite3.DatabaseError as error:
            code = getattr(error, "sqlite_errorcode", 11) & 0xFF
            if code in CORRUPT:
                self._is_damaged = True
                self.trouble = f"the journal was damaged during the run ({error})"

    @property
    def _is_in_place(self) -> bool:
        """Whether the path leads to the open file."""
        return self._identity is None or self._identity == _identity(self.path)

    def _note_place(self) -> None:
        if not self._is_in_place:
            # The open file takes results all the same: a directory that was moved has them.
            self.trouble = f"the journal {self.path} was moved or removed during the run"

    def _note_damage(self, error: sqlite3.DatabaseError) -> bool:
        """Return whether an error is damage by another program, which a run survives in memory."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        # A run has checked the table at its start.
        if self._lock is None or not (code in CORRUPT or "no such table" in str(error)):
            return False
        self._is_damaged = True
        self.trouble = f"the journal was damaged during the run ({error}); results stay in memory"
        return True

    def _check_values(self, rows: Iterable[tuple[Any, ...]]) -> None:
        """Raise ``sqlite3.IntegrityError`` for a value that the table cannot hold, without it."""
        for key, _, about, *_ in rows:
            try:
                json.loads(about, parse_constant=_refuse)
            except ValueError as error:
                raise sqlite3.IntegrityError(f"{key}: {error}") from error

    def remove(self, key: str) -> None:
        """Remove a result, if it exists."""
        self._unsaved.pop(key, None)
        with suppress(sqlite3.DatabaseError):  # a full disk, a lock, a damaged file
            self._db.execute("DELETE FROM result WHERE key = ?", [printable(key)])

    def prune(self, named: Iterable[str]) -> int:
        """Remove points, estimates and scenes whose keys are not ``named``. Return the bytes set
        free.

        Raises :class:`UserError` if the disk is too full for that. No result in use is lost then.
        """
        before = self._size()
        marks = ", ".join("?" * len(PRUNED))
        unnamed = "key NOT IN (SELECT key FROM named)"
        with undamaged(self.path):
            with self._needs_room("nothing was removed"):
                # The pages of the log go to the file, which sets the log's own bytes free.
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                # In a table, since a query takes less than a thousand values.
                # Some builds of SQLite overwrite deleted rows with zeros, which takes room in the log.
                self._db.execute("PRAGMA secure_delete = OFF")
                self._db.execute("PRAGMA temp_store = MEMORY")
                self._db.execute("CREATE TEMPORARY TABLE named (key TEXT PRIMARY KEY)")
                rows = [(key,) for key in named]
                self._db.executemany("INSERT OR IGNORE INTO named VALUES (?)", rows)
                self._db.execute(
                    f"DELETE FROM result WHERE kind IN ({marks}) AND {unnamed}", PRUNED
                )
                # A copy in memory might be too large for it.
                self._db.execute("PRAGMA temp_store = DEFAULT")
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            # Deleted rows leave free pages, which VACUUM removes; the log is as large as the rest.
            with self._needs_room(
                "unused results are removed, and the next run uses their bytes, but the file keeps its size"
            ):
                self._db.execute("VACUUM")
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return before - self._size()

    def _size(self) -> int:
        """Return the bytes of the file and of its log."""
        log = self.path.with_name(f"{self.path.name}-wal")
        return sum(path.stat().st_size for path in (self.path, log) if path.exists())

    @contextmanager
    def _needs_room(self, outcome: str) -> Iterator[None]:
        """Convert SQLite's report of a full disk to a :class:`UserError` with the outcome."""
        try:
            yield
        except sqlite3.OperationalError as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code in UNUSABLE or code in CORRUPT:
                raise
            raise UserError(f"{self.path}: {outcome}: {error}; make room on the disk") from error

    # Reading

    def about(self, keys: Iterable[str]) -> dict[str, Any]:
        """Return the JSON values about the results with these keys, if they exist, by key."""
        return {key: json.loads(about) for key, about in self._columns("about", keys)}

    def data(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Return the data of the results with these keys, if they exist, by key."""
        return dict(self._columns("data", keys))

    def of_kind(self, kind: Kind) -> dict[str, Any]:
        """Return the JSON values about all results of a kind, by key, in the order of writing."""
        query = "SELECT key, kind, about, digest FROM result WHERE kind = ? ORDER BY rowid"
        rows = self._rows(query, [kind])
        found = {key: json.loads(about) for key, about in self._whole(rows, ABOUT)}
        unsaved = (each for each in self._unsaved.values() if each.kind is kind)
        return found | {each.key: each.about for each in unsaved}

    def source(self, keys: Sequence[str]) -> "Source":
        """Return where a worker finds the points with these keys: in the file, or in the returned
        value.
        """
        # Workers read the file themselves: points of a scene may be hundreds of MB.
        if self._unsaved or not self._has_file or self._is_damaged or not self._is_in_place:
            return self.held(keys)
        return Source(self.directory, {})

    def held(self, keys: Sequence[str]) -> "Source":
        """Return the points with these keys, to send them to a worker."""
        return Source(None, self.data(keys))

    def _columns(self, column: str, keys: Iterable[str]) -> Iterator[tuple[str, Any]]:
        asked = list(dict.fromkeys(keys))
        # Unsaved results are newer than the rows of the file.
        stored = [key for key in asked if key not in self._unsaved]
        for start in range(0, len(stored), MAX_KEYS):
            part = [printable(key) for key in stored[start : start + MAX_KEYS]]
            marks = ", ".join("?" * len(part))
            query = f"SELECT key, kind, {column}, digest FROM result WHERE key IN ({marks})"
            rows = self._rows(query, part)
            yield from self._whole(rows, ABOUT if column == "about" else DATA)
        for key in asked:
            if key in self._unsaved:
                unsaved = self._unsaved[key]
                yield key, json.dumps(unsaved.about) if column == "about" else unsaved.data

    def _rows(self, query: str, values: Sequence[str]) -> list[tuple[str, str, Any, bytes]]:
        try:
            with undamaged(self.path):
                return self._db.execute(query, values).fetchall()
        except UserError as error:
            cause = error.__cause__
            if isinstance(cause, sqlite3.DatabaseError) and self._note_damage(cause):
                return []  # these results are missing, and are computed again
            raise
        except sqlite3.DatabaseError as error:
            if self._note_damage(error):
                return []
            raise

    def _whole(
        self, rows: Iterable[tuple[str, str, Any, bytes]], part: slice
    ) -> Iterator[tuple[str, Any]]:
        """Yield key and value of the rows whose value fits its part of the digest."""
        for key, kind, value, digest in rows:
            if digest[part] == _digest(key, kind, value):
                yield key, value
            else:
                self.damaged.add(key)
                # Damaged rows of earlier runs are removed when a run opens its store.
                if self._lock is not None and self._has_file:
                    self._is_damaged = True
                    self.trouble = "the journal was damaged during the run; results stay in memory"

    def warn_of_damage(self) -> None:
        """Warn of the rows that were read and do not fit their digest."""
        if count := len(self.damaged):
            warn_once(
                f"{plural(count, 'result')} of {self.path}, damaged, were not read; the run's command "
                "computes them again"
            )

    # Opening

    def _remove_damaged_rows(self) -> None:
        """Remove the rows that do not fit their digest: their results are missing, and are computed
        again.
        """
        query = "SELECT key, kind, about, data, digest FROM result"
        for key, kind, about, data, digest in self._db.execute(query):
            if digest != _digest(key, kind, about) + _digest(key, kind, data):
                self.damaged.add(key)
        if self.damaged and self._has_file:
            with suppress(sqlite3.OperationalError):  # a full disk
                keys = [(key,) for key in self.damaged]
                self._db.executemany("DELETE FROM result WHERE key = ?", keys)

    def _take_lock(self, path: Path, opened: ExitStack) -> None:
        try:
            with undamaged(path, "remove it"):
                # A separate file, so that others can read the store during a run.
                self._lock = opened.enter_context(closing(connected(path)))
                # SQLite releases the lock with the process, however it ends.
                self._lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:  # not a byte of the disk is free
            raise OSError(errno.ENOSPC, str(error)) from error

    def _open_file(self, opened: ExitStack) -> None:
        try:
            self._db = opened.enter_context(closing(connected(self.path)))
            self._prepare()
        except sqlite3.OperationalError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF in UNUSABLE - {CANNOT_OPEN}:
                raise
            self.trouble = f"the journal cannot be written ({error}); results stay in memory"
            self._has_file = False
            self._db.close()
            self._open_without_writing(opened)

    def _open_without_writing(self, opened: ExitStack) -> None:
        """Open the results of earlier runs, or an empty store in memory."""
        if self.path.exists():
            # A full disk has no room for SQLite's locks, either. Its files can be read, but for the
            # log of a run that was killed.
            if has_log(self.path):
                log = f"{self.path.name}-wal"
                self.trouble += f"; the latest results of the last run, in {log}, were not read"
            self._db = opened.enter_context(closing(connected(self.path, "immutable=1")))
            # A disk that became full in _prepare has a file without a table.
            if self._has_table():
                self._check()
                return
        self._db = opened.enter_context(closing(connected(":memory:")))
        self._db.execute(SCHEMA)

    def _prepare(self) -> None:
        if (
            not self._has_table()
            and self._db.execute("PRAGMA user_version").fetchone()[0] != FORMAT
        ):
            # Readers do not block the writer, and a commit is one append.
            self._db.execute("PRAGMA journal_mode = WAL")
            # In one transaction, so that no file has the table and not its format.
            self._db.executescript(f"BEGIN; {SCHEMA}; PRAGMA user_version = {FORMAT}; COMMIT;")
        else:
            self._check()
            # A reader has the file open, in the mode of a copy: the run writes between its reads.
            with suppress_busy():
                self._db.execute("PRAGMA journal_mode = WAL")
            # On a full disk, the first read in this mode fails: it makes an index of 32 kB.
            self._has_table()
        # A kill of the process loses no result. A power failure may lose the latest.
        self._db.execute("PRAGMA synchronous = NORMAL")
        self._db.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
        self._identity = _identity(self.path)

    def _has_table(self) -> bool:
        return self._db.execute("SELECT 1 FROM sqlite_master").fetchone() is not None

    def _check(self) -> None:
        """Raise :class:`UserError` for a file of another format, or for a damaged file."""
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if not version and not self._has_table():
            raise UserError(f"{self.path} has no results yet")
        if version != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not "
                f"{FORMAT}). Use that version, delete it with --fresh, or name another --work-dir."
            )
        # Another program may have added a trigger, or removed the table.
        query = (
            "SELECT type, name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite!_%' ESCAPE '!'"
        )
        schema = [(*each, sql.strip()) for *each, sql in self._db.execute(query)]
        if schema != [("table", "result", SCHEMA.strip())]:
            names = ", ".join(f"{kind} {name}" for kind, name, _ in schema) or "no table"
            raise UserError(
                f"{self.path} is damaged (it has {names}, and not the table of this program); "
                "delete it with --fresh"
            )
        # quick_check reads all pages, but does not compare the table with its index.
        trouble = self._db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if trouble != "ok":
            raise UserError(f"{self.path} is damaged ({trouble}); delete it with --fresh")


@dataclass(frozen=True, eq=False)
class Source:
    """Where a worker reads data: the store of a directory, or ``held`` if the store takes no more.

    A worker gets this in place of the data, and only this: it never writes.
    """

    directory: Path | None
    held: dict[str, bytes]

    def data(self, keys: Sequence[str]) -> dict[str, bytes]:
        """Return the data of the results with these keys, if they exist, by key."""
        if self.directory is None:
            return self.held
        with Store.read(self.directory, check=False) as store:
            return store.data(keys)

    def matches(self, keys: Sequence[str]) -> dict[str, Matches]:
        """Return the matches with these keys. Raise ``KeyError`` if one is missing."""
        found = self.data(keys)
        return {key: from_bytes(found[key]) for key in keys}


def connected(path: Path | str, options: str = "", timeout: float = 1.0) -> sqlite3.Connection:
    """Return a connection without Python's implicit transactions.

    ``path`` is a file, or ":memory:". ``options`` belong to the file's SQLite URI.
    """
    uri = f"{path.resolve().as_uri()}?{options}" if isinstance(path, Path) else f"file:{path}"
    return sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None)


ABOUT, DATA = slice(DIGEST_BYTES), slice(DIGEST_BYTES, None)  # the parts of a row's digest


def _row(result: Result) -> tuple[str, str, str, bytes, bytes]:
    # Names may have lone surrogates, from bytes that are no UTF-8; SQLite takes none.
    key = printable(result.key)
    about = printable(json.dumps(result.about))
    digest = _digest(key, result.kind, about) + _digest(key, result.kind, result.data)
    return key, str(result.kind), about, result.data, digest


def _digest(key: str, kind: str, value: str | bytes) -> bytes:
    """Return the digest of a part of a row. With the key, so that rows cannot be exchanged."""
    # Against accidents; a cryptographic digest would take four times as long, at each start of a run.
    found = zlib.crc32(f"{key}\n{kind}\n".encode())
    found = zlib.crc32(value.encode() if isinstance(value, str) else value, found)
    return found.to_bytes(DIGEST_BYTES, "little")


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, which identify it; ``None`` if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def has_log(path: Path) -> bool:
    """Return whether a store has a write-ahead log with results, as that of a killed run."""
    log = path.with_name(f"{path.name}-wal")
    return log.is_file() and log.stat().st_size > 0


def _with_its_log(path: Path, opened: ExitStack) -> Path:
    """Return a copy of a store with a write-ahead log, which SQLite cannot read in a read-only
    directory; a store without one is its own copy.
    """
    if not has_log(path):
        return path
    log = f"{path.name}-wal"
    with writing(f"a copy of {path}, whose log {log} cannot be read here,"):
        folder = Path(opened.enter_context(TemporaryDirectory(prefix="mkpc-")))
        for name in (path.name, log):
            shutil.copyfile(path.with_name(name), folder / name)
    # A connection that may write reads the log into the copy.
    with closing(connected(folder / path.name)) as copy:
        copy.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return folder / path.name


@contextmanager
def suppress_busy() -> Iterator[None]:
    """Ignore that another program has a lock."""
    try:
        yield
    except sqlite3.OperationalError as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF not in BUSY:
            raise


def closed_connection() -> sqlite3.Connection:
    """Return a connection that is closed already, for a store that is not open yet."""
    connection = sqlite3.connect(":memory:")
    connection.close()
    return connection


def to_bytes(matches: Matches) -> bytes:
    """Return the bytes of x0, y0, x1, y1 and score of each match, as little-endian float32."""
    # Exact, because workers return float32.
    columns = [matches.points0, matches.points1, matches.scores]
    return np.column_stack(columns).astype("<f4").tobytes()


def from_bytes(data: bytes) -> Matches:
    """Invert :func:`to_bytes`."""
    table = np.frombuffer(data, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])
