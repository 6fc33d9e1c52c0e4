"""The clock, the measured cost of every unit, and the choice of units that still fit."""

import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, sqrt

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.recipe import Unit

WINDOW = 64
"""How many of the latest measurements of a unit count."""
DOUBT = 0.4
"""The safety margin of a cost that was measured once; of one measured n times it is sqrt(n) times smaller."""
LEAST_DOUBT = 0.01
STALL = 10.0
"""A measurement this many times the upper quartile is a stall, and counts as no more."""


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
    """The time a run is given, in seconds of ``clock`` since ``started``; the clock never jumps.

    ``stop`` is when no unit may be running any more, ``end`` when nothing is waited for any longer; what is
    left then suffices to write the submission and to leave, and whoever has not left by ``last`` is thrown out.
    """

    started: float
    limit: float = inf
    clock: Callable[[], float] = time.monotonic

    @property
    def reserve(self) -> float:
        return min(max(1.5, 0.005 * self.limit), 60.0)

    @property
    def stop(self) -> float:
        return self.started + self.limit - self.reserve

    @property
    def end(self) -> float:
        return self.started + self.limit - self.reserve / 2

    @property
    def last(self) -> float:
        return self.started + self.limit - self.reserve / 4

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


class Measurements:
    """The latest measurements of one thing, in seconds."""

    def __init__(self) -> None:
        self.count = 0
        self._latest: deque[float] = deque(maxlen=WINDOW)
        self._mean = self._most = 0.0

    def add(self, seconds: float) -> None:
        self._latest.append(seconds)
        self.count += 1
        ranked = sorted(self._latest)
        # Encodings are cached, so a unit costs much on some pairs and little on others: a median would forecast
        # too little. Only what no cache explains is cut.
        stall = STALL * ranked[3 * len(ranked) // 4]
        self._mean = sum(min(value, stall) for value in ranked) / len(ranked) if stall > 0 else ranked[-1]
        self._most = ranked[9 * len(ranked) // 10]

    @property
    def mean(self) -> float:
        """What a thousand more will take on average; stalls are cut."""
        return self._mean

    @property
    def most(self) -> float:
        """What nine of ten do not exceed."""
        return self._most


class Costs:
    """What units cost on a pair, in seconds, as measured in this run.

    A unit's first measurement is its warm-up, and counts only as long as there is no other.
    """

    def __init__(self) -> None:
        self._measured: dict[str, Measurements] = {}
        self._warm_up: dict[str, float] = {}
        self._overhead = Measurements()

    def observe(self, unit: str, seconds: float) -> None:
        if unit not in self._warm_up:
            self._warm_up[unit] = seconds
            self._measured.pop(unit, None)
        else:
            self._measured.setdefault(unit, Measurements()).add(seconds)

    def observe_overhead(self, seconds: float) -> None:
        """Seconds of a worker that a pair took besides its units; by chance less than none."""
        self._overhead.add(seconds)

    def suppose(self, unit: str, seconds: float) -> None:
        """For a unit that was never reached: at least this much, until it is measured."""
        if unit not in self._warm_up:
            self._measured.setdefault(unit, Measurements()).add(seconds)

    def known(self, unit: str) -> bool:
        return unit in self._warm_up or unit in self._measured

    def of(self, unit: str) -> float:
        """Expected seconds on a pair; 0 for a unit that nothing is known of."""
        return self._measured[unit].mean if unit in self._measured else self._warm_up.get(unit, 0.0)

    def most(self, unit: str) -> float:
        """Seconds within which the unit most likely ends on a pair."""
        return self._measured[unit].most if unit in self._measured else self._warm_up.get(unit, 0.0)

    def longest(self, unit: str, factor: float) -> float:
        """Seconds after which the unit hangs: its warm-up, as on a new worker, and ``factor`` times its cost."""
        steady = self._measured[unit].most if unit in self._measured else 0.0
        return self._warm_up.get(unit, 0.0) + factor * steady

    def forecast(self, unit: str) -> float:
        """Expected seconds with a safety margin, which shrinks as more is known."""
        count = self._measured[unit].count if unit in self._measured else 1
        return self.of(unit) * (1 + max(LEAST_DOUBT, DOUBT / sqrt(count)))

    @property
    def overhead(self) -> float:
        return max(0.0, self._overhead.mean)


def longest_prefix(units: Sequence[Unit], lacking: Mapping[str, int], costs: Costs, seconds: float) -> int:
    """How many of ``units``, from the first on, can be finished in ``seconds`` of one worker on all pairs.

    ``lacking[name]`` is the number of pairs that have not had that unit yet.
    """
    for count, needed in enumerate(needs(units, lacking, costs)):
        if needed > seconds:
            return count
    return len(units)


def needs(units: Sequence[Unit], lacking: Mapping[str, int], costs: Costs) -> Iterable[float]:
    """The seconds that it takes to give all pairs the first unit, the first two, and so on."""
    pairs = max((lacking[unit.name] for unit in units), default=0)
    needed = costs.overhead * pairs
    for unit in units:
        needed += costs.forecast(unit.name) * lacking[unit.name]
        yield needed
