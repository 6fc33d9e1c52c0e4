"""Warnings that are given once a process."""

import warnings
from functools import cache


@cache
def warn_once(message: str) -> None:
    """Warn unless this process has given the same warning before."""
    warnings.warn(message, stacklevel=3)
