"""Errors and warnings for users, and parts of their texts."""

import errno
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from io import BufferedReader
from pathlib import Path
from tempfile import TemporaryDirectory

# A recipe, a list of pairs; a file given by mistake may have gigabytes
MAX_TEXT_BYTES = 1 << 24


class UserError(Exception):
    """A problem that the user can correct.

    The message states the problem, its location and the next step.
    """


@cache
def warn_once(message: str) -> None:
    """Warn once per process and message."""
    # The cache is the memory: the body runs once per message.
    warnings.warn(message, stacklevel=3)


def open_regular(path: Path) -> BufferedReader:
    """Open a file to read its bytes. Raise ``OSError``, also for a pipe or a device, which may never end."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return path.open("rb")


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file of at most 16 MiB, or raise :class:`UserError`."""
    try:
        with open_regular(path) as stream:
            data = stream.read(MAX_TEXT_BYTES + 1)
        if len(data) > MAX_TEXT_BYTES:
            raise UserError(f"{path} is too large: the limit is 16 MiB; split it")
        return data.decode("utf-8-sig")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text") from error


def plural(count: int, noun: str) -> str:
    """Return the count with its noun, such as "1 batch" or "2 batches"."""
    if count == 1:
        return f"{count} {noun}"
    ending = "es" if noun.endswith("ch") else "s"  # batches, matches
    return f"{count} {noun}{ending}"


def shown(name: object) -> str:
    """Return a name for messages; control characters, which terminals obey, are escaped."""
    letters = []
    for letter in str(name):
        letters.append(letter if letter.isprintable() else repr(letter)[1:-1])
    return "".join(letters)


def printable(text: str) -> str:
    """Return ``text`` with escapes for characters that UTF-8 cannot encode, as paths may have."""
    return text.encode("utf-8", "backslashreplace").decode()


@contextmanager
def temporary_directory() -> Iterator[Path]:
    """Yield a directory that is removed afterwards. Raise :class:`UserError` if there is no place
    for one.
    """
    try:
        made = TemporaryDirectory(prefix="mkpc-")
    except OSError as error:
        raise UserError(
            f"no temporary directory: {error.strerror}; set TMPDIR to a directory that can be written"
        ) from error
    with made as name:
        yield Path(name)


@contextmanager
def writing(what: str) -> Iterator[None]:
    """Convert an ``OSError`` in the block to a :class:`UserError` about writing ``what``."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what} cannot be written: {error.strerror or error}") from error
