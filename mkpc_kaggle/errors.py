"""What goes wrong on the user's side, told so that the user can mend it."""

from collections.abc import Iterator
from contextlib import contextmanager


class UserError(Exception):
    """The run cannot start: the message says what happened, where, and what to do next."""


@contextmanager
def writing(what: str) -> Iterator[None]:
    """Write the file that ``what`` names; an ``OSError`` becomes a :class:`UserError` that says so."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what} cannot be written: {error.strerror}") from error
