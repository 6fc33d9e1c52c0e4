"""The clock, the measured cost of every unit, and the choice of units that still fit."""

import re
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.recipe import Unit

SAFETY = 0.05
"""The share of the time left that forecasts leave unspent: later passes use it up."""
WINDOW = 64
"""How many of the latest measurements of a unit count."""


def parse_duration(text: str) -> float:
    """Seconds from ``8h45m``, ``90m``, ``60s`` or plain seconds; raises :class:`UserError` for anything else."""
    parts = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip())
    if parts is None or not any(parts.groups()):
        raise UserError(f"{text!r} is no duration; write it as 8h45m, 90m, 60s or a number of seconds")
    hours, minutes, seconds = (float(part or 0) for part in parts.groups())
    if hours + minutes + seconds == 0:
        raise UserError("a time limit of nothing leaves no time to work")
    return hours * 3600 + minutes * 60 + seconds


def format_duration(seconds: float) -> str:
    """Such as ``8h45m``, ``12m03s`` or ``4.2s``."""
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}m{rest:02d}s" if minutes < 60 else f"{minutes // 60}h{minutes % 60:02d}m"


@dataclass(frozen=True)
class Budget:
    """The time a run is given, in seconds of the monotonic clock since ``started``.

    ``stop`` is when no unit may be running any more, ``end`` when nothing is waited for any longer; what is
    left then suffices to write the submission and to leave.
    """

    started: float
    limit: float = inf

    @property
    def reserve(self) -> float:
        return min(max(1.5, 0.01 * self.limit), 60.0)

    @property
    def stop(self) -> float:
        return self.started + self.limit - self.reserve

    @property
    def end(self) -> float:
        return self.started + self.limit - self.reserve / 2

    def left(self) -> float:
        """Seconds until :attr:`stop`; never negative."""
        return max(0.0, self.stop - time.monotonic())


class Costs:
    """What units cost on a pair, in seconds, as measured in this run.

    The mean of the latest measurements: encodings are cached, so that a unit costs much on some pairs and
    little on others, and only the mean tells what a thousand of them will take. A unit's first measurement
    is its warm-up, and counts only as long as there is no other.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, deque[float]] = {}
        self._warm_up: dict[str, float] = {}
        self._overhead: deque[float] = deque(maxlen=WINDOW)

    def observe(self, unit: str, seconds: float) -> None:
        if unit not in self._warm_up:
            self._warm_up[unit] = seconds
        else:
            self._seconds.setdefault(unit, deque(maxlen=WINDOW)).append(seconds)

    def observe_overhead(self, seconds: float) -> None:
        """Seconds a pair took besides its units: waiting for decoding or for F."""
        self._overhead.append(max(0.0, seconds))

    def suppose(self, unit: str, seconds: float) -> None:
        """For a unit that was never reached: at least this much, until it is measured."""
        if unit not in self._warm_up:
            self._seconds.setdefault(unit, deque(maxlen=WINDOW)).append(seconds)

    def known(self, unit: str) -> bool:
        return unit in self._warm_up or unit in self._seconds

    def of(self, unit: str) -> float:
        """Expected seconds on a pair; 0 for a unit that nothing is known of."""
        if self._seconds.get(unit):
            return _mean(self._seconds[unit])
        return self._warm_up.get(unit, 0.0)

    @property
    def overhead(self) -> float:
        return _mean(self._overhead) if self._overhead else 0.0


def longest_prefix(units: Sequence[Unit], lacking: Mapping[str, int], costs: Costs, seconds: float) -> int:
    """How many of ``units``, from the first on, can be finished in ``seconds`` on all pairs.

    ``lacking[name]`` is the number of pairs that have not had that unit yet.
    """
    pairs = max(lacking.values(), default=0)
    needed = costs.overhead * pairs
    for count, unit in enumerate(units):
        needed += costs.of(unit.name) * lacking[unit.name]
        if needed > seconds * (1 - SAFETY):
            return count
    return len(units)


def _mean(values: deque[float]) -> float:
    return sum(values) / len(values)
