"""The store of a run: an SQLite file that has each result under the digest of its inputs.

There is one table. ``about`` is JSON, all that reports need; ``data`` are a unit's points. Results
under unused keys stay until they are pruned or the run starts with --fresh. The parent alone
writes, one transaction for each answer. It reads the store once, at its start, and keeps its state
in memory (:mod:`state`).
"""

import errno
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

import numpy as np

from mkpc_kaggle.errors import UserError, printable, writing
from mkpc_kaggle.geometry.matches import Matches

FORMAT = 18  # increase it when a kind of result is stored differently: nothing is converted
FILE_NAME = "journal.sqlite"  # named in the documentation, and in scripts of users
LOCK_NAME = "journal.lock"
# STRICT refuses values of a wrong type, and json_valid refuses numbers that are not JSON, such as NaN.
# Both would be noticed only when a report is made.
SCHEMA = """
CREATE TABLE result (
    key TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    about TEXT NOT NULL CHECK (json_valid(about)),
    data BLOB NOT NULL
) STRICT
"""
MIN_SQLITE = (3, 37, 0)  # STRICT tables
MAX_KEYS = 500  # in a query; SQLite allows 999 values

# SQLite's primary result codes. Only CORRUPT means damage, for which the advice is to delete the file:
# wrong advice costs the user hours of results.
CORRUPT = {11, 26}  # a malformed file, and a file that is no database
UNUSABLE = {3, 5, 6, 8, 14}  # no permission, busy, locked, read only, cannot be opened
CANNOT_OPEN = 14


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
        self.trouble = ""  # the reason why results stay in memory, if they do
        self._has_file = True  # false if the disk was full already at the start
        self._unsaved: dict[str, Result] = {}  # results that the file did not take
        self._db = closed_connection()
        self._lock: sqlite3.Connection | None = None

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
        # SQLite cannot create its locks in a read-only directory, and needs none there.
        is_writable = os.access(directory, os.W_OK)
        mode = "mode=ro" if is_writable else "mode=ro&immutable=1"
        with ExitStack() as opened, undamaged(store.path):
            store._db = opened.enter_context(closing(connected(store.path, mode, timeout=5.0)))
            # One transaction for all reads: the run may publish meanwhile.
            store._db.execute("BEGIN")
            if check:
                store._check()
            opened.pop_all()
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._lock is not None:
            self.put([])  # the disk may have room again
            with suppress(sqlite3.Error):  # unless a reader uses the file
                self._db.execute("PRAGMA journal_mode = DELETE")  # a single file, to copy
            self._lock.close()
        self._db.close()

    # Writing

    def put(self, results: Iterable[Result]) -> None:
        """Save results, all or none. Results that the file does not take wait in memory.

        Raises ``sqlite3.IntegrityError`` for results that the table cannot hold, such as a number
        that is NaN.
        """
        # Waiting results are tried again with each later one: the disk may have room again.
        new = {result.key: result for result in results}
        waiting = self._unsaved | new
        if not waiting:
            return
        # Names may have lone surrogates, from bytes that are no UTF-8; SQLite takes none.
        rows = [
            (printable(each.key), each.kind, printable(json.dumps(each.about)), each.data)
            for each in waiting.values()
        ]
        try:
            with self._db:
                self._db.execute("BEGIN")
                # REPLACE: a table of pairs and the facts of a file have the same key each time.
                self._db.executemany("REPLACE INTO result VALUES (?, ?, ?, ?)", rows)
        except sqlite3.OperationalError as error:  # a full disk
            self.trouble = str(error)
            self._unsaved = waiting
        else:
            self._unsaved = {}

    def remove(self, key: str) -> None:
        """Remove a result, if it exists."""
        self._unsaved.pop(key, None)
        with suppress(sqlite3.OperationalError):  # a full disk
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
        query = "SELECT key, about FROM result WHERE kind = ? ORDER BY rowid"
        with undamaged(self.path):
            rows = self._db.execute(query, [kind]).fetchall()
        found = {key: json.loads(about) for key, about in rows}
        unsaved = (each for each in self._unsaved.values() if each.kind is kind)
        return found | {each.key: each.about for each in unsaved}

    def source(self, keys: Sequence[str]) -> "Source":
        """Return where a worker finds the points with these keys: in the file, or in the returned
        value.
        """
        # Workers read the file themselves: points of a scene may be hundreds of MB.
        if self._unsaved or not self._has_file:
            return Source(None, self.data(keys))
        return Source(self.directory, {})

    def _columns(self, column: str, keys: Iterable[str]) -> Iterator[tuple[str, Any]]:
        asked = list(dict.fromkeys(keys))
        # Unsaved results are newer than the rows of the file.
        stored = [key for key in asked if key not in self._unsaved]
        for start in range(0, len(stored), MAX_KEYS):
            part = [printable(key) for key in stored[start : start + MAX_KEYS]]
            marks = ", ".join("?" * len(part))
            query = f"SELECT key, {column} FROM result WHERE key IN ({marks})"
            with undamaged(self.path):
                yield from self._db.execute(query, part).fetchall()
        for key in asked:
            if key in self._unsaved:
                unsaved = self._unsaved[key]
                yield key, json.dumps(unsaved.about) if column == "about" else unsaved.data

    # Opening

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
            self.trouble = str(error)
            self._has_file = False
            self._db.close()
            self._open_without_writing(opened)

    def _open_without_writing(self, opened: ExitStack) -> None:
        """Open the results of earlier runs, or an empty store in memory."""
        if self.path.exists():
            # A full disk has no room for SQLite's locks, either. Its files can be read.
            self._db = opened.enter_context(closing(connected(self.path, "immutable=1")))
            # A disk that became full in _prepare has a file without a table.
            if self._has_table():
                self._check()
                return
        self._db = opened.enter_context(closing(connected(":memory:")))
        self._db.execute(SCHEMA)

    def _prepare(self) -> None:
        if not self._has_table():
            # Readers do not block the writer, and a commit is one append.
            self._db.execute("PRAGMA journal_mode = WAL")
            # In one transaction, so that no file has the table and not its format.
            self._db.executescript(f"BEGIN; {SCHEMA}; PRAGMA user_version = {FORMAT}; COMMIT;")
        else:
            self._check()
            self._db.execute("PRAGMA journal_mode = WAL")
            # On a full disk, the first read in this mode fails: it makes an index of 32 kB.
            self._has_table()
        # A kill of the process loses no result. A power failure may lose the latest.
        self._db.execute("PRAGMA synchronous = NORMAL")

    def _has_table(self) -> bool:
        return self._db.execute("SELECT 1 FROM sqlite_master").fetchone() is not None

    def _check(self) -> None:
        """Raise :class:`UserError` for a file of another format, or for a damaged file."""
        if self._db.execute("PRAGMA user_version").fetchone()[0] != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not "
                f"{FORMAT}). Use that version, delete it with --fresh, or name another --work-dir."
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
