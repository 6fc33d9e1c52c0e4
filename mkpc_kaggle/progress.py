"""Progress of a wait: tqdm's bars, and the text of a duration."""

import re
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from select import select
from typing import TextIO, TypeVar

from mkpc_kaggle.errors import UserError

LINE_INTERVAL_S = 30.0  # between lines where a line cannot be redrawn in place
REDRAW_S = 0.2  # between redraws: a reader sees no more, and a terminal may be slow
MAX_SILENCE_S = 1.0  # before a bar: shorter waits need none

Item = TypeVar("Item")


def format_duration(seconds: float) -> str:
    """Return text such as ``8h45m``, ``12m03s`` or ``4.2s``."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"
    )


def parse_duration(text: str) -> float:
    """Return the seconds of ``8h45m``, ``90m``, ``60s`` or a number. Raise :class:`UserError` for
    other text.
    """
    parts = re.fullmatch(
        r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s)?|(\d+(?:\.\d+)?)", text.strip()
    )
    if parts is None or not any(parts.groups()):
        raise UserError(
            f"{text!r} is not a duration; write it as 8h45m, 90m, 60s or a number of seconds"
        )
    hours, minutes, seconds, number = (float(part or 0) for part in parts.groups())
    if not (total := hours * 3600 + minutes * 60 + seconds + number):
        raise UserError("a time limit of 0 leaves no time to work")
    return total


def counted(items: Sequence[Item], what: str, unit: str) -> Iterable[Item]:
    """Return the items with a bar that counts them on the standard error stream."""
    from tqdm import tqdm  # most commands do not need it

    interval = REDRAW_S if is_terminal(sys.stderr) else LINE_INTERVAL_S
    return tqdm(
        items, what, unit=unit, delay=MAX_SILENCE_S, mininterval=interval, leave=False
    )


def print_to(stream: TextIO | None, text: str, end: str = "\n") -> None:
    """Print a text if that is possible; ``None`` is no stream."""
    with suppress(OSError, ValueError):  # lost terminal, full disk, or closed stream
        if stream is not None:
            # A blocked print holds the stream's lock, for which the start of any process waits.
            with suppress(OSError, ValueError, TypeError):
                select([], [stream], [])
            print(text, file=stream, flush=True, end=end)


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream writes to a terminal."""
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # a closed stream
        return False
