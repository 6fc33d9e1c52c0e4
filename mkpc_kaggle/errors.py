"""Errors and warnings that say what the user can do about the cause."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

MAX_TEXT_BYTES = 1 << 24


class UserError(Exception):
    """The run cannot start: the message says what happened, where, and what to do next."""


@cache
def warn_once(message: str) -> None:
    """Warn, unless this process has given the same warning before."""
    warnings.warn(message, stacklevel=3)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file of at most 16 MiB; :class:`UserError` if it cannot be read."""
    try:
        if path.exists() and not path.is_file():
            raise UserError(f"{path} cannot be read: not a regular file")
        if path.exists() and (size := path.stat().st_size) > MAX_TEXT_BYTES:
            raise UserError(f"{path} cannot be read: {size} bytes, at most {MAX_TEXT_BYTES} are; split it")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text") from error


def shown(name: object) -> str:
    """Return a name for messages, its control characters escaped: they end lines and drive terminals."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(name))


@contextmanager
def writing(what: str) -> Iterator[None]:
    """Write the file that ``what`` names; an ``OSError`` becomes a :class:`UserError` that says so."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what} cannot be written: {error.strerror}") from error
