"""The store of a run: an SQLite file that has each result under the digest of its inputs.

Results under unused keys stay until the run starts with --fresh. The parent alone writes, one transaction for each
answer. A disk that takes no more costs the journal, not the run: rows go to a database in memory, and to the file
when it has room again.
"""

import errno
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Self

from mkpc_kaggle.engine.records import from_bytes
from mkpc_kaggle.errors import UserError, printable, writing
from mkpc_kaggle.geometry.matches import Matches

FILE_NAME = "journal.sqlite"  # named in the documentation, and in scripts of users
LOCK_NAME = "journal.lock"
MAX_KEYS = 500  # in a query; SQLite allows 999 values
RETRY_S = 30.0  # between tries to write rows that the file did not take
BUSY_TIMEOUT_MS = 100  # for the lock of another program, while the loop waits
# SQLite's primary result codes. Only CORRUPT means damage, for which the advice is to delete the file:
# wrong advice costs the user hours of results.
CORRUPT = {11, 26}  # a malformed file, and a file that is no database
UNUSABLE = {3, 5, 6, 8, 14}  # no permission, busy, locked, read only, cannot be opened
CANNOT_OPEN = 14

# The first column of each is its key. A row of points without data is a unit that the pair does not need.
TABLES = {
    "points": """key TEXT PRIMARY KEY, matches INTEGER, keypoints INTEGER, decode_seconds REAL,
        encode_seconds REAL, match_seconds REAL, cluster_seconds REAL, scale REAL, detail REAL, regions TEXT,
        note TEXT, data BLOB""",
    # Estimates, scenes and shortlists, as JSON
    "result": "key TEXT PRIMARY KEY, facts TEXT",
    "image": """name TEXT PRIMARY KEY, size INTEGER, changed INTEGER, digest TEXT, width INTEGER, height INTEGER,
        focal REAL""",
    # The rows of the version that was published last
    "pair": """number INTEGER PRIMARY KEY, id TEXT, batch TEXT, image0 TEXT, image1 TEXT, points TEXT,
        estimate TEXT, F BLOB, source TEXT, choice TEXT, reasons TEXT""",
    "run": "number INTEGER PRIMARY KEY, about TEXT",
}
KEYS = {table: columns.split(maxsplit=1)[0] for table, columns in TABLES.items()}
SCHEMA = ";\n".join(f"CREATE TABLE main.{name} ({columns})" for name, columns in TABLES.items())
SPARE = SCHEMA.replace("TABLE main.", "TABLE spare.") + "".join(
    f";\nCREATE TEMP VIEW {name} AS SELECT * FROM spare.{name} UNION ALL SELECT * FROM main.{name} "
    f"WHERE {key} NOT IN (SELECT {key} FROM spare.{name})"
    for name, key in KEYS.items()
)
# Increase it when the JSON or the bytes of a column change their meaning: nothing is converted.
REVISION = 1
STORE_FORMAT = zlib.crc32(f"{REVISION} {SCHEMA}".encode()) >> 1  # SQLite has 31 bits for it


class Store:
    """The store of a work directory. :meth:`open` gives one to write, :meth:`read` a snapshot.

    ``path`` is the file, or ``None`` if all is in memory. ``trouble`` is a sentence on what keeps the file
    from having all results, if anything.
    """

    def __init__(self, directory: Path, db: sqlite3.Connection, path: Path | None = None) -> None:
        self.directory = directory
        self.path = path
        self.db = db
        self.trouble = ""
        self._lock: sqlite3.Connection | None = None
        self._has_spare = False  # rows that the file did not take
        self._retry_at = 0.0  # on the monotonic clock

    @classmethod
    def in_memory(cls, directory: Path) -> Self:
        """Return a store that leaves no file."""
        store = cls(directory, connected(":memory:"))
        store.db.executescript(f"{SCHEMA};")
        store._add_spare()
        return store

    @classmethod
    def open(cls, directory: Path, *, fresh: bool = False) -> Self:
        """Return a store to write, created if missing. No other run can open it at the same time.

        Raises :class:`UserError` if the directory is not writable or in use, and for a damaged file
        or a file of an earlier format.
        """
        with ExitStack() as opened, writing(f"the work directory {directory}"):
            directory.mkdir(parents=True, exist_ok=True)
            path = directory / FILE_NAME
            lock = directory / LOCK_NAME
            for each in (lock, path):
                if each.exists() and not each.is_file():
                    raise UserError(
                        f"{each} is not a regular file; remove it, or name another --work-dir"
                    )
            held = opened.enter_context(closing(_locked(lock)))
            if fresh:
                # A write-ahead log of a former file would be applied to the new one.
                for ending in ("", "-journal", "-wal", "-shm"):
                    directory.joinpath(FILE_NAME + ending).unlink(missing_ok=True)
            with undamaged(path):
                try:
                    store = cls(directory, opened.enter_context(closing(connected(path))), path)
                    store._prepare()
                except sqlite3.OperationalError as error:
                    if code_of(error) in UNUSABLE - {CANNOT_OPEN}:
                        raise
                    store.db.close()
                    store = cls._without_writing(directory, path)
                    store.trouble = (
                        f"the journal cannot be written ({error}); results stay in memory"
                    )
            store._lock = held
            store._add_spare()
            opened.pop_all()  # nothing is closed on leaving
        return store

    @classmethod
    def _without_writing(cls, directory: Path, path: Path) -> Self:
        """Return the results of earlier runs, whose disk is full, or else an empty store in memory."""
        with suppress(sqlite3.OperationalError, UserError):
            # A full disk has no room for SQLite's locks, either.
            store = cls(directory, connected(path, "immutable=1"), path)
            store._check()
            return store
        store = cls(directory, connected(":memory:"))
        store.db.executescript(f"{SCHEMA};")
        return store

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Return a snapshot of a store, even while a run writes to it.

        Raises :class:`UserError` if the file is missing, damaged, or of another format.
        """
        path = directory / FILE_NAME
        if not path.is_file():
            name = f"{directory} has no {FILE_NAME}"
            raise UserError(f"{name}: name the work directory of a run (NAME.work, or OUT/work)")
        with ExitStack() as opened, undamaged(path):
            try:
                db = opened.enter_context(closing(connected(path, "mode=rw", timeout=5.0)))
                db.execute("BEGIN")  # one transaction for all reads: the run may publish
                store = cls(directory, db, path)
                store._check()
            except sqlite3.OperationalError:
                # SQLite cannot create its locks in a read-only directory, and needs none there.
                db = opened.enter_context(closing(connected(path, "immutable=1")))
                store = cls(directory, db, path)
                store._check()
            db.execute("PRAGMA query_only = ON")
            opened.pop_all()
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._lock is not None:
            self.flush()
            with suppress(sqlite3.Error):  # a full disk
                # If no reader uses the file, closing leaves a single file, to copy.
                self.db.execute("PRAGMA main.wal_checkpoint(TRUNCATE)")
            self._lock.close()
            self._lock = None
        self.db.close()

    # Writing

    def put(self, rows: Mapping[str, Iterable[Sequence[Any]]]) -> None:
        """Save rows by table, all or none. Rows that the file does not take stay in memory, and are tried
        again.
        """
        # Not with each answer, because waiting for a lock and writing many rows take time.
        if not self._has_spare or monotonic() >= self._retry_at:
            try:
                with self.db:
                    self.db.execute("BEGIN IMMEDIATE")
                    if self._has_spare:
                        for table in TABLES:
                            self.db.execute(
                                f"REPLACE INTO main.{table} SELECT * FROM spare.{table}"
                            )
                            self.db.execute(f"DELETE FROM spare.{table}")
                    self._insert("main", rows)
            except sqlite3.DatabaseError as error:  # a full disk, a lock, a damaged file
                self.trouble = f"the journal cannot be written ({error}); results stay in memory"
                self._retry_at = monotonic() + RETRY_S
            else:
                if self._has_spare:
                    self._has_spare = False
                    self.trouble = ""
                return
        with self.db:
            self.db.execute("BEGIN")
            self._insert("spare", rows)
        self._has_spare = True

    def flush(self) -> str:
        """Try to write the rows that wait in memory. Return why the file does not have all results, or an
        empty text.
        """
        self._retry_at = 0.0
        self.put({})
        return self.trouble

    def _insert(self, where: str, rows: Mapping[str, Iterable[Sequence[Any]]]) -> None:
        for table, values in rows.items():
            marks = ", ".join("?" * (TABLES[table].count(",") + 1))
            self.db.executemany(f"REPLACE INTO {where}.{table} VALUES ({marks})", values)

    # Reading

    def select(self, table: str, columns: str, keys: Iterable[Any]) -> Iterator[tuple[Any, ...]]:
        """Yield these columns of the rows with these keys, if they exist."""
        texts = [printable(key) if isinstance(key, str) else key for key in keys]
        for start in range(0, len(texts), MAX_KEYS):
            part = texts[start : start + MAX_KEYS]
            marks = ", ".join("?" * len(part))
            key = KEYS[table.removeprefix("spare.")]
            query = f"SELECT {columns} FROM {table} WHERE {key} IN ({marks})"
            yield from self.db.execute(query, part).fetchall()

    def facts(self, keys: Iterable[str]) -> dict[str, str]:
        """Return results as JSON by key, if they exist."""
        return dict(self.select("result", "key, facts", keys))

    def source(self, keys: Sequence[str]) -> "Source":
        """Return where a worker finds the points with these keys."""
        held: dict[str, bytes] = {}
        if self.path is None:
            held = dict(self.select("points", "key, data", keys))
        elif self._has_spare:
            held = dict(self.select("spare.points", "key, data", keys))
        return Source(self.path, held)

    # Opening

    def _prepare(self) -> None:
        if not self._has_table():
            # Readers do not block the writer, and a commit is one append.
            self.db.execute("PRAGMA journal_mode = WAL")
            # In one transaction, so that no file has the tables and not their format.
            self.db.executescript(f"BEGIN; {SCHEMA}; PRAGMA user_version = {STORE_FORMAT}; COMMIT;")
        else:
            self._check()
            # On a full disk this fails: it makes an index of 32 kB.
            self.db.execute("PRAGMA journal_mode = WAL")
            self._has_table()
        # A kill of the process loses no result. A power failure may lose the latest.
        self.db.execute("PRAGMA synchronous = NORMAL")
        self.db.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")

    def _add_spare(self) -> None:
        self.db.execute("ATTACH ':memory:' AS spare")
        self.db.executescript(f"{SPARE};")

    def _has_table(self) -> bool:
        return self.db.execute("SELECT 1 FROM sqlite_master").fetchone() is not None

    def _check(self) -> None:
        """Raise :class:`UserError` for a file of another format, or for a damaged file."""
        version = self.db.execute("PRAGMA user_version").fetchone()[0]
        if not version and not self._has_table():
            raise UserError(f"{self.path} has no results yet")
        if version != STORE_FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not "
                f"{STORE_FORMAT}). Use that version, delete it with --fresh, or name another --work-dir."
            )
        trouble = self.db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if trouble != "ok":
            raise UserError(f"{self.path} is damaged ({trouble}); delete it with --fresh")


@dataclass(frozen=True, eq=False)
class Source:
    """Where a worker reads points: in the store's file, and ``held`` those that only memory has."""

    path: Path | None = None
    held: dict[str, bytes] = field(default_factory=dict)

    def matches(self, keys: Iterable[str]) -> dict[str, Matches]:
        """Return the matches with these keys. Raise ``KeyError`` if one is missing."""
        keys = list(keys)
        found = dict(self.held)
        missing = [key for key in keys if key not in found]
        if missing and self.path is not None:
            with closing(connected(self.path, "mode=ro", timeout=5.0)) as db:
                found |= Store(self.path.parent, db).select("points", "key, data", missing)
        return {key: from_bytes(found[key]) for key in keys}


def code_of(error: sqlite3.Error) -> int:
    """Return SQLite's primary result code; 0 for an error of Python's module itself."""
    # The low byte is the primary code; the higher bytes are details of it.
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Convert SQLite's report of a damaged file, or of one that cannot be used, to a
    :class:`UserError`.
    """
    try:
        yield
    except sqlite3.DatabaseError as error:
        code = code_of(error)
        if code in UNUSABLE:
            text = f"{path} cannot be used: {error}; is another run using it?"
            raise UserError(text) from error
        if code in CORRUPT:
            raise UserError(f"{path} is damaged ({error}); {advice}") from error
        raise


def connected(path: Path | str, options: str = "", timeout: float = 1.0) -> sqlite3.Connection:
    """Return a connection without Python's implicit transactions.

    ``path`` is a file, or ":memory:". ``options`` belong to the file's SQLite URI.
    """
    uri = f"{path.resolve().as_uri()}?{options}" if isinstance(path, Path) else f"file:{path}"
    return sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None)


def _locked(path: Path) -> sqlite3.Connection:
    """Return a connection that has the lock of a work directory, which others can read during a run."""
    try:
        with undamaged(path, "remove it"):
            lock = connected(path)
            # SQLite releases the lock with the process, however it ends.
            lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:  # not a byte of the disk is free
        raise OSError(errno.ENOSPC, str(error)) from error
    return lock
