"""Errors and warnings for the user, told so that the user can mend the cause."""

import warnings
from functools import cache


class UserError(Exception):
    """The run cannot start: the message says what happened, where, and what to do next."""


@cache
def warn_once(message: str) -> None:
    """Warn, unless this process has given the same warning before."""
    warnings.warn(message, stacklevel=3)
