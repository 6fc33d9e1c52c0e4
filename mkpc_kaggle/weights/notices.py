"""Warnings that one process gives once."""

import warnings
from functools import cache


@cache
def warn_once(message: str) -> None:
    """Warn unless this process has said the very same before."""
    warnings.warn(message, stacklevel=3)
