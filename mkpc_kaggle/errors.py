"""Errors and warnings for the user, told so that the user can mend the cause."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache


class UserError(Exception):
    """The run cannot start: the message says what happened, where, and what to do next."""


@cache
def warn_once(message: str) -> None:
    """Warn, unless this process has given the same warning before."""
    warnings.warn(message, stacklevel=3)


@contextmanager
def writing(what: str) -> Iterator[None]:
    """Write the file that ``what`` names; an ``OSError`` becomes a :class:`UserError` that says so."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what} cannot be written: {error.strerror}") from error
