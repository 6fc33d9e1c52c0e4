"""The store of a run: an SQLite file that has each result under the digest of its inputs.

The tables and their columns are in :mod:`tables`. Results under unused keys stay until they are
pruned or the run starts with --fresh. The parent alone writes, one transaction for each answer. It
reads the store once, at its start, and keeps its state in memory
(:mod:`mkpc_kaggle.engine.plan.state`).
"""

import errno
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Self, TypeVar

from mkpc_kaggle.engine.store.layout import Layout
from mkpc_kaggle.engine.store.rows import (
    DATA,
    FACTS,
    RowKey,
    StoredRow,
    by_table,
    checksum_of,
    data_checksum,
    facts_checksum,
    from_bytes,
)
from mkpc_kaggle.engine.store.sqlite_file import (
    CANNOT_OPEN,
    CORRUPT,
    UNUSABLE,
    closed_connection,
    code_of,
    connected,
    has_log,
    identity_of,
    suppress_busy,
    undamaged,
    with_its_log,
)
from mkpc_kaggle.engine.store.tables import LAYOUTS, PRUNED, SCHEMA, STORE_FORMAT
from mkpc_kaggle.errors import UserError, plural, printable, warn_once, writing
from mkpc_kaggle.geometry.matches import Matches

FILE_NAME = "journal.sqlite"  # named in the documentation, and in scripts of users
LOCK_NAME = "journal.lock"
MIN_SQLITE = (3, 37, 0)  # STRICT tables
MAX_KEYS = 500  # in a query; SQLite allows 999 values
LATEST_BYTES = 8 << 20  # twice the log, which SQLite copies to the file at 1,000 pages
RETRY_S = 30.0  # between tries to write results that the file did not take
# For the lock of another program, while the loop waits
BUSY_TIMEOUT_MS = 100


T = TypeVar("T")


class Store:
    """The store of a work directory. :meth:`open` gives one to write, :meth:`read` a snapshot."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.path = directory / FILE_NAME
        self.trouble = ""  # a sentence on what keeps the file from having all results, if anything
        self.damaged: set[RowKey] = set()  # rows that do not fit their checksum
        self._has_file = True  # false if the disk was full already at the start
        self._is_damaged = False  # by another program, since the file was opened
        self._identity: tuple[int, int] | None = None  # of the open file
        self._unsaved: dict[RowKey, StoredRow] = {}  # results that the file did not take
        self._latest: dict[RowKey, int] = {}  # the latest results in the file, and their bytes
        self._latest_bytes = 0
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
            raise UserError(f"{name}: name the work directory of a run (NAME.work, or OUT/work)")
        path = store.path
        # The last connection removes SQLite's other files, which a read-only one would leave.
        mode = "mode=rw"
        with ExitStack() as opened, undamaged(path):
            # SQLite cannot create its locks in a read-only directory, and needs none there.
            if not os.access(directory, os.W_OK):
                mode = "mode=ro&immutable=1"
                path = with_its_log(path, opened)
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

    def put(self, rows: Iterable[Any]) -> None:
        """Save rows, dataclasses of :mod:`tables`, all or none. Rows that cannot be written
        stay in memory.

        Raises ``sqlite3.IntegrityError`` for values that a table cannot hold, such as a number that
        is NaN.
        """
        new = {row.key: row for row in map(StoredRow.of, rows)}
        self._note_place()
        if self._is_damaged or (self._unsaved and monotonic() < self._retry_at):
            self._unsaved |= new
            return
        # Waiting results are tried again: the disk may have room, or the lock may be free.
        together = self._unsaved | new
        if not together:
            return
        try:
            with self._db:
                self._db.execute("BEGIN IMMEDIATE")
                for table, values in by_table(together.values()).items():
                    marks = ", ".join("?" * len(values[0]))
                    # REPLACE: a published pair and the facts of a file have the same key each time.
                    self._db.executemany(f"REPLACE INTO {table} VALUES ({marks})", values)
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
            self._note_written(together)

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

    def _note_written(self, rows: dict[RowKey, "StoredRow"]) -> None:
        for key, row in rows.items():
            # Removed first: a row that is written again is the latest.
            self._latest_bytes += row.size - self._latest.pop(key, 0)
            self._latest[key] = row.size
        while self._latest_bytes > LATEST_BYTES:
            self._latest_bytes -= self._latest.pop(next(iter(self._latest)))

    def _check_latest(self) -> None:
        """Read the latest results again, as they are in the log. SQLite copies the log to the file
        unread, with all that another program has written there.
        """
        if not self._latest or not self._has_file or self._is_damaged or not self._is_in_place:
            return
        # Another connection, which has no page in memory
        try:
            with closing(connected(self.path, "mode=ro")) as reader:
                for layout in LAYOUTS.values():
                    keys = [key for table, key in self._latest if table == layout.table]
                    for part in parts_of(keys):
                        marks = ", ".join("?" * len(part))
                        where = f"WHERE {layout.key} IN ({marks})"
                        rows = reader.execute(f"SELECT * FROM {layout.table} {where}", part)
                        if not all(row[-1] == checksum_of(layout, row[:-1]) for row in rows):
                            raise sqlite3.DatabaseError("a result does not fit its checksum")
        except sqlite3.DatabaseError as error:
            # No code: the error raised here, or text that is no UTF-8.
            if code_of(error) in {0, *CORRUPT}:
                self._is_damaged = True
                self.trouble = f"the journal was damaged during the run ({error})"

    @property
    def _is_in_place(self) -> bool:
        """Whether the path leads to the open file."""
        return self._identity is None or self._identity == identity_of(self.path)

    def _note_place(self) -> None:
        if not self._is_in_place:
            # The open file takes results all the same: a directory that was moved has them.
            self.trouble = f"the journal {self.path} was moved or removed during the run"

    def _note_damage(self, error: sqlite3.DatabaseError) -> bool:
        """Return whether an error is damage by another program, which a run survives in memory."""
        code = code_of(error)
        # A run has checked the table at its start.
        if self._lock is None or not (code in CORRUPT or "no such table" in str(error)):
            return False
        self._is_damaged = True
        self.trouble = f"the journal was damaged during the run ({error}); results stay in memory"
        return True

    def remove(self, kind: type, key: str) -> None:
        """Remove a row of a table, if it exists."""
        layout = LAYOUTS[kind]
        self._unsaved.pop((layout.table, key), None)
        with suppress(sqlite3.DatabaseError):  # a full disk, a lock, a damaged file
            query = f"DELETE FROM {layout.table} WHERE {layout.key} = ?"
            self._db.execute(query, [printable(key)])

    def prune(self, named: Iterable[str]) -> int:
        """Remove points, estimates and scenes whose keys are not ``named``. Return the bytes set
        free.

        Raises :class:`UserError` if the disk is too full for that. No result in use is lost then.
        """
        before = self._size()
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
                for kind in PRUNED:
                    query = f"DELETE FROM {LAYOUTS[kind].table} WHERE key NOT IN named"
                    self._db.execute(query)
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
            code = code_of(error)
            if code in UNUSABLE or code in CORRUPT:
                raise
            raise UserError(f"{self.path}: {outcome}: {error}; make room on the disk") from error

    # Reading

    def get(self, kind: type[T], keys: Iterable[Any]) -> dict[Any, T]:
        """Return the rows with these keys, if they exist, by key, without their data."""
        layout = LAYOUTS[kind]
        rows = map(layout.row, self.facts(kind, keys))
        return {getattr(row, layout.key): row for row in rows}

    def all(self, kind: type[T]) -> list[T]:
        """Return all rows of a table in the order of writing, without their data."""
        return list(map(LAYOUTS[kind].row, self.facts(kind)))

    def facts(self, kind: type, keys: Iterable[Any] | None = None) -> Iterator[tuple[Any, ...]]:
        """Yield the facts of the rows with these keys, as SQLite has them; by default of all rows
        in the order of writing.
        """
        layout = LAYOUTS[kind]
        asked = None if keys is None else list(keys)
        waiting = self._waiting(layout, asked)
        for key, facts in self._read(layout, layout.names, FACTS, asked):
            if key not in waiting:
                yield facts
        for row in waiting.values():
            yield row.facts

    def data(self, kind: type, keys: Iterable[str]) -> dict[str, bytes]:
        """Return the data of the rows with these keys, if they exist, by key."""
        layout = LAYOUTS[kind]
        asked = list(keys)
        found = {key: data for key, (data,) in self._read(layout, "data", DATA, asked)}
        return found | {key: saved.row.data for key, saved in self._waiting(layout, asked).items()}

    def source(self, kind: type, keys: Sequence[str]) -> "Source":
        """Return where a worker finds the data of rows: in the file, or in the returned value."""
        # Workers read the file themselves: points of a scene may be hundreds of MB.
        if self._unsaved or not self._has_file or self._is_damaged or not self._is_in_place:
            return self.held(kind, keys)
        return Source(kind, self.directory, {})

    def held(self, kind: type, keys: Sequence[str]) -> "Source":
        """Return the data of rows, to send it to a worker."""
        return Source(kind, None, self.data(kind, keys))

    def _waiting(self, layout: Layout[Any], keys: Iterable[Any] | None) -> dict[Any, "StoredRow"]:
        """Return the rows of a table that the file did not take, by key; ``None`` means all of them."""
        if keys is None:
            keys = [key for table, key in self._unsaved if table == layout.table]
        rows = {key: self._unsaved.get((layout.table, key)) for key in keys}
        return {key: row for key, row in rows.items() if row is not None}

    def _read(
        self, layout: Layout[Any], columns: str, part: slice, keys: Iterable[Any] | None
    ) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Yield the key and these columns of the file's whole rows with these keys, or of all."""
        query = f"SELECT {layout.key}, {columns}, checksum FROM {layout.table}"
        if keys is None:
            yield from self._whole(layout, self._rows(f"{query} ORDER BY rowid", []), part)
            return
        # Unsaved results are newer than the rows of the file.
        asked = [key for key in dict.fromkeys(keys) if (layout.table, key) not in self._unsaved]
        for some in parts_of(asked):
            marks = ", ".join("?" * len(some))
            rows = self._rows(f"{query} WHERE {layout.key} IN ({marks})", some)
            yield from self._whole(layout, rows, part)

    def _rows(self, query: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
        try:
            with undamaged(self.path):
                return list(self._select(query, values))
        except UserError as error:
            cause = error.__cause__
            if isinstance(cause, sqlite3.DatabaseError) and self._note_damage(cause):
                return []  # these results are missing, and are computed again
            raise
        except sqlite3.DatabaseError as error:
            if self._note_damage(error):
                return []
            raise

    def _select(self, query: str, values: Sequence[Any] = ()) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, perhaps some of them twice if the file is damaged."""
        try:
            yield from self._db.execute(query, values)
        except sqlite3.OperationalError as error:
            if "decode" not in str(error):
                raise
            # Damaged text is no UTF-8. It can be read, and does not fit its checksum.
            self._db.text_factory = partial(str, encoding="utf-8", errors="backslashreplace")
            yield from self._db.execute(query, values)

    def _whole(
        self, layout: Layout[Any], rows: Iterable[tuple[Any, ...]], part: slice
    ) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Yield key and values of the rows whose values fit their ``part`` of the checksum, facts
        or data.
        """
        for key, *values, checksum in rows:
            right = (
                facts_checksum(layout, values)
                if part is FACTS
                else data_checksum(layout, key, *values)
            )
            if checksum[part] == right:
                yield key, tuple(values)
            else:
                self.damaged.add((layout.table, key))
                # Damaged rows of earlier runs are removed when a run opens its store.
                if self._lock is not None and self._has_file:
                    self._is_damaged = True
                    self.trouble = "the journal was damaged during the run; results stay in memory"

    def warn_of_damage(self) -> None:
        """Warn of the rows that were read and do not fit their checksum."""
        if count := len(self.damaged):
            warn_once(
                f"{plural(count, 'result')} of {self.path}, damaged, were not read; the run's command "
                "computes them again"
            )

    # Opening

    def _remove_damaged_rows(self) -> None:
        """Remove the rows that do not fit their checksum: their results are missing, and are
        computed again.
        """
        for layout in LAYOUTS.values():
            number = [column.name for column in layout.facts].index(layout.key)
            for row in self._select(f"SELECT * FROM {layout.table}"):
                if row[-1] != checksum_of(layout, row[:-1]):
                    self.damaged.add((layout.table, row[number]))
        if self.damaged and self._has_file:
            with suppress(sqlite3.OperationalError):  # a full disk
                for layout in LAYOUTS.values():
                    keys = [(key,) for table, key in self.damaged if table == layout.table]
                    query = f"DELETE FROM {layout.table} WHERE {layout.key} = ?"
                    self._db.executemany(query, keys)

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
            if code_of(error) in UNUSABLE - {CANNOT_OPEN}:
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
        self._db.executescript(SCHEMA)

    def _prepare(self) -> None:
        if (
            not self._has_table()
            and self._db.execute("PRAGMA user_version").fetchone()[0] != STORE_FORMAT
        ):
            # Readers do not block the writer, and a commit is one append.
            self._db.execute("PRAGMA journal_mode = WAL")
            # In one transaction, so that no file has the tables and not their format.
            self._db.executescript(f"BEGIN; {SCHEMA} PRAGMA user_version = {STORE_FORMAT}; COMMIT;")
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
        self._identity = identity_of(self.path)

    def _has_table(self) -> bool:
        return self._db.execute("SELECT 1 FROM sqlite_master").fetchone() is not None

    def _check(self) -> None:
        """Raise :class:`UserError` for a file of another format, or for a damaged file."""
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if not version and not self._has_table():
            raise UserError(f"{self.path} has no results yet")
        if version != STORE_FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not "
                f"{STORE_FORMAT}). Use that version, delete it with --fresh, or name another --work-dir."
            )
        # Another program may have added a trigger, or removed a table.
        query = (
            "SELECT type, name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite!_%' ESCAPE '!'"
        )
        schema = [(kind, name, sql) for kind, name, sql in self._db.execute(query)]
        if schema != [("table", layout.table, layout.sql) for layout in LAYOUTS.values()]:
            names = ", ".join(f"{kind} {name}" for kind, name, _ in schema) or "no table"
            raise UserError(
                f"{self.path} is damaged (it has {names}, and not the tables of this program); "
                "delete it with --fresh"
            )
        # quick_check reads all pages, but does not compare tables with their indices.
        trouble = self._db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if trouble != "ok":
            raise UserError(f"{self.path} is damaged ({trouble}); delete it with --fresh")


@dataclass(frozen=True, eq=False)
class Source:
    """Where a worker reads the data of a table: the store of a directory, or ``held`` if the store
    takes no more.

    A worker gets this in place of the data, and only this: it never writes.
    """

    kind: type
    directory: Path | None = None
    held: dict[str, bytes] = field(default_factory=dict)

    def data(self, keys: Sequence[str]) -> dict[str, bytes]:
        """Return the data of the results with these keys, if they exist, by key."""
        if self.directory is None:
            return self.held
        with Store.read(self.directory, check=False) as store:
            return store.data(self.kind, keys)

    def matches(self, keys: Sequence[str]) -> dict[str, Matches]:
        """Return the matches with these keys. Raise ``KeyError`` if one is missing."""
        found = self.data(keys)
        return {key: from_bytes(found[key]) for key in keys}


def parts_of(keys: Iterable[Any]) -> Iterator[list[Any]]:
    """Yield keys as SQLite has them, in parts for one query each."""
    texts = [printable(key) if isinstance(key, str) else key for key in keys]
    for start in range(0, len(texts), MAX_KEYS):
        yield texts[start : start + MAX_KEYS]
