"""The clock: durations, and how much of a run's time is left."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf

from mkpc_kaggle.errors import UserError


def parse_duration(text: str) -> float:
    """Seconds from ``8h45m``, ``90m``, ``60s`` or plain seconds; raises :class:`UserError` for anything else."""
    parts = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)(s?))?", text.strip())
    if parts is None or not any(parts.groups()):
        raise UserError(f"{text!r} is no duration; write it as 8h45m, 90m, 60s or a number of seconds")
    if parts[3] and not parts[4] and (parts[1] or parts[2]):
        unit = "s" if parts[2] else "m"
        raise UserError(f"{text!r} does not say what {parts[3]} counts; write {text.strip()}{unit}")
    hours, minutes, seconds = (float(part or 0) for part in parts.groups()[:3])
    if hours + minutes + seconds == 0:
        raise UserError("a time limit of nothing leaves no time to work")
    return hours * 3600 + minutes * 60 + seconds


def format_duration(seconds: float) -> str:
    """Such as ``8h45m``, ``12m03s`` or ``4.2s``."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"


TELLING = 5
"""What the summary of a run takes at most, as a multiple of what writing its submission takes."""
MOST_WRITING = 0.05
"""The share of the limit that writing may be thought to take."""


@dataclass
class Budget:
    """The time a run is given, in seconds of ``clock`` since ``started``; the clock never jumps.

    ``stop`` is when no unit may be running any more, ``end`` when nothing is waited for any longer; what is
    left then suffices to write the submission and to end; a process that has not ended by ``last`` is made to,
    the submission written once more if need be. ``writing`` are the seconds which that takes, learnt in the run.
    """

    started: float
    limit: float = inf
    clock: Callable[[], float] = time.monotonic
    writing: float = 0.0

    @property
    def reserve(self) -> float:
        return min(max(1.5, 0.005 * self.limit), 60.0)

    @property
    def stop(self) -> float:
        return self.end - self.reserve / 2

    @property
    def end(self) -> float:
        return self.last - self.reserve / 4 - TELLING * min(self.writing, MOST_WRITING * self.limit)

    @property
    def last(self) -> float:
        return self.over - self.reserve / 4 - self.writing

    @property
    def over(self) -> float:
        """When the limit is over."""
        return self.started + self.limit

    def left(self) -> float:
        """Seconds until :attr:`stop`; never negative."""
        return max(0.0, self.stop - self.clock())

    def spent(self) -> float:
        """Seconds since the start."""
        return self.clock() - self.started


def monotonic_of(epoch: float) -> float:
    """The monotonic clock's time at a moment of the wall clock, in seconds since 1970.

    Asked once, when a run starts: however the wall clock jumps later, the run's limit does not move. Raises
    :class:`UserError` for a moment to come.
    """
    ago = time.time() - epoch
    if not 0 <= ago < inf:
        raise UserError(f"--started-at {epoch:g} is no moment of the past; it is in seconds since 1970 (date +%s)")
    return time.monotonic() - ago
