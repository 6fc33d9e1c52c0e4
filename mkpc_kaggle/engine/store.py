"""The store of a run: an SQLite file that has each result under the digest of its inputs.

Results under unused keys stay until the run starts with --fresh. The parent alone writes, one transaction for each
answer. A disk that takes no more costs the journal, not the run: rows go to a database in memory, and to the file
when it has room again.
"""

import errno
import json
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from time import monotonic
from typing import Any, Self

from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.critical_region import regions_json
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult

FILE_NAME = "journal.sqlite"  # named in the documentation, and in scripts of users
LOCK_NAME = "journal.lock"
RETRY_S = 30.0  # between tries to write rows that the file did not take
TIMEOUT_S = 0.5  # for a lock of another program: the loop of a run waits, too
# Ways to open a file. SQLite cannot create its locks in a read-only directory or on a full disk, and an immutable
# file needs none.
WRITE, READ, IMMUTABLE = "mode=rwc", "mode=rw", "immutable=1"

# A row of points without data is a unit that the pair does not need.
TABLES = {
    "points": """key TEXT PRIMARY KEY, matches INTEGER, keypoints INTEGER, seconds REAL, scale REAL,
        detail REAL, regions TEXT, note TEXT, data BLOB""",
    # Estimates and scenes, as JSON
    "result": "key TEXT PRIMARY KEY, facts TEXT",
    "image": """key TEXT PRIMARY KEY, size INTEGER, changed INTEGER, digest TEXT, width INTEGER, height INTEGER,
        focal REAL""",
    # The rows of the version that was published last. ``units`` has a list [unit, key, is needed, failure] for
    # each unit with points or a failure, as JSON.
    "pair": """key INTEGER PRIMARY KEY, id TEXT, batch TEXT, image0 TEXT, image1 TEXT, units TEXT,
        estimate TEXT, F BLOB, source TEXT, choice TEXT, error TEXT""",
    "run": "key INTEGER PRIMARY KEY, rows INTEGER, about TEXT",
}
SCHEMA = ";\n".join(
    f"CREATE TABLE main.{name} ({columns})" for name, columns in TABLES.items()
)
SPARE = "ATTACH ':memory:' AS spare;\n"
SPARE += SCHEMA.replace("TABLE main.", "TABLE spare.") + "".join(
    f";\nCREATE TEMP VIEW {name} AS SELECT * FROM spare.{name} UNION ALL SELECT * FROM main.{name} "
    f"WHERE key NOT IN (SELECT key FROM spare.{name})"
    for name in TABLES
)
# Increase it when the JSON or the bytes of a column change their meaning: nothing is converted.
REVISION = 1
STORE_FORMAT = zlib.crc32(f"{REVISION} {SCHEMA}".encode()) >> 1  # SQLite has 31 bits for it


def points_row(key: str, result: UnitResult) -> tuple[Any, ...]:
    """Return the row of a unit's points on a pair. A unit that the pair does not need has no data."""
    need = result.need
    return (
        key,
        len(result.matches),
        result.keypoints,
        result.seconds,
        None if need is None else need.scale,
        None if need is None else need.detail,
        regions_json(result.regions) if result.regions else "",
        result.note,
        result.matches.to_bytes() if result.is_needed else None,
    )


@dataclass(eq=False)
class Store:
    """The store of a work directory. :meth:`open` gives one to write, :meth:`read` a snapshot.

    ``path`` is the file, or ``None`` if it cannot be written. ``trouble`` is a sentence on what keeps the file
    from having all results, if anything: some are in the database ``spare``, in memory, and are written at
    ``retry_at`` on the monotonic clock. ``lock`` is that of a store to write.
    """

    directory: Path
    db: sqlite3.Connection
    path: Path | None = None
    trouble: str = ""
    retry_at: float = -inf
    lock: sqlite3.Connection | None = None

    @classmethod
    def open(cls, directory: Path, *, fresh: bool = False) -> Self:
        """Return a store to write, created if missing. No other run can open it at the same time.

        Raises :class:`UserError` if the directory is not writable or in use, and for a damaged file
        or a file of an earlier format.
        """
        with ExitStack() as opened, writing(f"the work directory {directory}"):
            directory.mkdir(parents=True, exist_ok=True)
            lock = opened.enter_context(closing(_locked(directory / LOCK_NAME)))
            if fresh:
                # A write-ahead log of a former file would be applied to the new one.
                for ending in ("", "-journal", "-wal", "-shm"):
                    directory.joinpath(FILE_NAME + ending).unlink(missing_ok=True)
            store = cls._writable(directory)
            store.lock = lock
            opened.pop_all()  # the lock stays
        store.db.executescript(SPARE)
        return store

    @classmethod
    def _writable(cls, directory: Path) -> Self:
        path = directory / FILE_NAME
        with undamaged(path):
            try:
                return cls(directory, checked(path, WRITE), path)
            except sqlite3.OperationalError as error:
                trouble = error
        # The results of earlier runs, if any
        try:
            store = cls(directory, checked(path, IMMUTABLE))
        except (sqlite3.OperationalError, UserError):
            store = cls(directory, connected(":memory:"))
            create(store.db)
        store._note(trouble)
        return store

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Return a snapshot of a store, even while a run writes to it.

        Raises :class:`UserError` if the file is missing, damaged, or of another format.
        """
        path = directory / FILE_NAME
        if not path.is_file():
            name = f"{directory} has no {FILE_NAME}"
            raise UserError(
                f"{name}: name the work directory of a run (NAME.work, or OUT/work)"
            )
        with undamaged(path):
            try:
                return cls(directory, checked(path, READ), path)
            except sqlite3.OperationalError:
                return cls(directory, checked(path, IMMUTABLE), path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self.lock is not None:
            self.flush()
            with suppress(sqlite3.Error):  # a full disk
                # If no reader uses the file, closing leaves a single file, to copy.
                self.db.execute("PRAGMA main.wal_checkpoint(TRUNCATE)")
            self.lock.close()
            self.lock = None
        self.db.close()

    # Writing

    def put(self, rows: Mapping[str, Iterable[Sequence[Any]]]) -> None:
        """Save rows by table, all or none. Rows that the file does not take stay in memory, and are tried
        again.
        """
        # Not with each answer, because waiting for a lock and writing many rows take time.
        if monotonic() >= self.retry_at:
            try:
                self._insert("main", rows)
            except sqlite3.DatabaseError as error:  # a full disk, a lock, a damaged file
                self._note(error)
            else:
                self.retry_at = -inf
                self.trouble = ""
                return
        self._insert("spare", rows)

    def flush(self) -> str:
        """Try to write the rows that wait in memory. Return why the file does not have all results, or an
        empty text.
        """
        if self.path is not None:
            self.retry_at = -inf
        self.put({})
        return self.trouble

    def _note(self, error: sqlite3.DatabaseError) -> None:
        self.trouble = f"the journal cannot be written ({error}); results stay in memory"
        self.retry_at = inf if self.path is None else monotonic() + RETRY_S

    def _insert(self, where: str, rows: Mapping[str, Iterable[Sequence[Any]]]) -> None:
        with self.db:
            self.db.execute("BEGIN")
            for table in TABLES if where == "main" and self.trouble else ():
                self.db.execute(f"REPLACE INTO main.{table} SELECT * FROM spare.{table}")
                self.db.execute(f"DELETE FROM spare.{table}")
            for table, values in rows.items():
                marks = ", ".join("?" * (TABLES[table].count(",") + 1))
                self.db.executemany(f"REPLACE INTO {where}.{table} VALUES ({marks})", values)

    # Reading

    def select(self, table: str, columns: str, keys: Iterable[str]) -> list[tuple[Any, ...]]:
        """Return these columns of the rows with these keys, if they exist. Raise :class:`UserError` if the file
        cannot be read.
        """
        texts = json.dumps(list(keys))
        query = f"SELECT {columns} FROM {table} WHERE key IN (SELECT value FROM json_each(?))"
        with undamaged(self.directory / FILE_NAME):
            return self.db.execute(query, [texts]).fetchall()

    def facts(self, keys: Iterable[str]) -> dict[str, str]:
        """Return results as JSON by key, if they exist."""
        return dict(self.select("result", "key, facts", keys))

    def source(self, keys: Sequence[str], *, is_sent: bool = False) -> "Source":
        """Return where a worker finds the points with these keys; with ``is_sent``, the points themselves, for
        another machine.
        """
        held: dict[str, bytes] = {}
        with suppress(UserError):  # a disk that fails costs the job: the worker reads, too
            table = "points" if is_sent or self.path is None else "spare.points"
            held = dict(self.select(table, "key, data", keys))
        return Source(self.path, held)


@dataclass(frozen=True, eq=False)
class Source:
    """Where a worker reads points: in the store's file, and ``held`` those that only memory has."""

    path: Path | None = None
    held: dict[str, bytes] = field(default_factory=dict)

    def matches(self, keys: Iterable[str]) -> dict[str, Matches]:
        """Return the matches with these keys. Raise ``KeyError`` if one is missing."""
        found = dict(self.held)
        missing = [key for key in keys if key not in found]
        if missing and self.path is not None:
            with closing(connected(self.path, "mode=ro")) as db:
                found |= Store(self.path.parent, db).select("points", "key, data", missing)
        return {key: Matches.from_bytes(found[key]) for key in keys}


def connected(path: Path | str, options: str = "") -> sqlite3.Connection:
    """Return a connection without Python's implicit transactions.

    ``path`` is a file, or ":memory:". ``options`` belong to the file's SQLite URI.
    """
    uri = f"{path.resolve().as_uri()}?{options}" if isinstance(path, Path) else f"file:{path}"
    db = sqlite3.connect(uri, uri=True, timeout=TIMEOUT_S, isolation_level=None)
    # Sorting must not need a disk, which may be full.
    db.execute("PRAGMA temp_store = MEMORY")
    return db


def checked(path: Path, options: str) -> sqlite3.Connection:
    """Return a connection to a store. Raise :class:`UserError` for a file of another format, and
    :class:`sqlite3.DatabaseError` for a damaged file or one that cannot be opened like this.
    """
    with ExitStack() as opened:
        db = opened.enter_context(closing(connected(path, options)))
        has_table = db.execute("SELECT 1 FROM sqlite_master").fetchone() is not None
        if options == WRITE and not has_table:
            # Readers do not block the writer, and a commit is one append.
            db.execute("PRAGMA journal_mode = WAL")
            create(db)
        elif not has_table:
            raise UserError(f"{path} has no results yet")
        if options == WRITE:
            # A kill of the process loses no result. A power failure may lose the latest.
            db.execute("PRAGMA synchronous = NORMAL")
        if options == READ:
            db.execute("BEGIN")  # one transaction for all reads: the run may publish
        if db.execute("PRAGMA user_version").fetchone()[0] != STORE_FORMAT:
            raise UserError(
                f"{path} was written by another version of this program (its format is not "
                f"{STORE_FORMAT}). Use that version, delete it with --fresh, or name another --work-dir."
            )
        for table in TABLES:
            # Reads the index of a table. Other pages are read when they are needed, which costs a job.
            db.execute(f"SELECT count(*) FROM {table}")
        opened.pop_all()
    return db


def create(db: sqlite3.Connection) -> None:
    """Create the tables of an empty database."""
    # In one transaction, so that no file has the tables and not their format.
    db.executescript(f"BEGIN; {SCHEMA}; PRAGMA user_version = {STORE_FORMAT}; COMMIT;")


@contextmanager
def undamaged(path: Path) -> Iterator[None]:
    """Convert SQLite's report of a damaged file, or of one that cannot be used, to a :class:`UserError`."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise UserError(
            f"{path} cannot be used: {error}; is another run using it?"
        ) from error
    except sqlite3.DatabaseError as error:
        # The advice costs the user hours of results, so not for errors of this program, which are subclasses.
        if type(error) is not sqlite3.DatabaseError:
            raise
        raise UserError(f"{path} is damaged ({error}); delete it with --fresh") from error


def _locked(path: Path) -> sqlite3.Connection:
    """Return a connection that has the lock of a work directory, which others can read during a run."""
    try:
        lock = connected(path, WRITE)
        # SQLite releases the lock with the process, however it ends.
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.DatabaseError as error:
        if "locked" in str(error):
            raise UserError(f"{path} is locked: is another run using it?") from error
        # Not a byte of the disk is free.
        raise OSError(errno.ENOSPC, str(error)) from error
    return lock
