"""SQLite files: connections, and the meaning of SQLite's errors."""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from mkpc_kaggle.errors import UserError, writing

# SQLite's primary result codes. Only CORRUPT means damage, for which the advice is to delete the file:
# wrong advice costs the user hours of results.
CORRUPT = {11, 26}  # a malformed file, and a file that is no database
UNUSABLE = {3, 5, 6, 8, 14}  # no permission, busy, locked, read only, cannot be opened
CANNOT_OPEN = 14
BUSY = {5, 6}  # another program has a lock


def code_of(error: sqlite3.Error) -> int:
    """Return SQLite's primary result code; 0 for an error of Python's module itself."""
    # The low byte is the primary code; the higher bytes are details of it.
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Convert SQLite's report of a damaged file, or of one that cannot be used, to a
    :class:`UserError`.

    Everything else is a fault of the machine or of the program, and stays as it is.
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


@contextmanager
def suppress_busy() -> Iterator[None]:
    """Ignore that another program has a lock."""
    try:
        yield
    except sqlite3.OperationalError as error:
        if code_of(error) not in BUSY:
            raise


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


def has_log(path: Path) -> bool:
    """Return whether a store has a write-ahead log with results, as that of a killed run."""
    log = path.with_name(f"{path.name}-wal")
    return log.is_file() and log.stat().st_size > 0


def with_its_log(path: Path, opened: ExitStack) -> Path:
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


def identity_of(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, which identify it; ``None`` if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
