"""What units cost, as measured during the run, and what follows: which units fit, and when a worker hangs."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

from mkpc_kaggle.recipe import Unit

WINDOW = 64
"""How many of the latest measurements of a unit count."""
DOUBT = 0.4
"""The safety margin of a cost that was measured once; of one measured n times it is sqrt(n) times smaller."""
LEAST_DOUBT = 0.01
STALL = 10.0
"""A measurement this many times the upper quartile is a stall, and counts as no more."""


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

    A worker's first run of a unit is its warm-up, which says nothing of the pairs to come: it counts only as long
    as there is no other measurement, and in no forecast.
    """

    def __init__(self) -> None:
        self._measured: dict[str, Measurements] = {}
        self._warm_up: dict[str, float] = {}
        self._supposed: set[str] = set()
        self._overhead = Measurements()

    def observe(self, unit: str, seconds: float, *, warm_up: bool = False) -> None:
        if unit in self._supposed:
            self._supposed.remove(unit)
            del self._measured[unit]
        if warm_up:
            self._warm_up[unit] = seconds
        else:
            self._measured.setdefault(unit, Measurements()).add(seconds)

    def observe_overhead(self, seconds: float) -> None:
        """Seconds of a worker that a pair took besides its units; by chance less than none."""
        self._overhead.add(seconds)

    def suppose(self, unit: str, seconds: float) -> None:
        """For a unit that was never reached: at least this much, until it is measured."""
        if unit in self._supposed or (unit not in self._warm_up and unit not in self._measured):
            self._supposed.add(unit)
            self._measured.setdefault(unit, Measurements()).add(seconds)

    def known(self, unit: str) -> bool:
        """Whether more than its warm-up is known."""
        return unit in self._measured

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
        """Expected seconds with a safety margin, which shrinks as more is known; 0 as long as nothing is."""
        if unit not in self._measured:
            return 0.0
        return self.of(unit) * (1 + max(LEAST_DOUBT, DOUBT / sqrt(self._measured[unit].count)))

    @property
    def overhead(self) -> float:
        return max(0.0, self._overhead.mean)


def needs(units: Sequence[Unit], lacking: Mapping[str, int], costs: Costs) -> Iterator[float]:
    """The seconds that it takes to give all pairs the first unit, the first two, and so on.

    ``lacking[name]`` is the number of pairs that have not had that unit yet.
    """
    pairs = max((lacking[unit.name] for unit in units), default=0)
    needed = costs.overhead * pairs
    for unit in units:
        needed += costs.forecast(unit.name) * lacking[unit.name]
        yield needed


@dataclass(frozen=True)
class Timeouts:
    """When a silent worker is taken to hang: after ``floor`` seconds and ``factor`` times what a unit should take.

    It is heard of before each unit on each ``batch`` of pairs. ``unknown`` seconds are allowed where nobody knows
    what a unit costs. A machine that suddenly becomes ten times slower is not taken to hang. A short run
    waits less: for ``share`` of its limit, but ``least`` seconds, in place of the floor; for an unknown unit as
    long as it may be explored.
    """

    floor: float = 60.0
    factor: float = 10.0
    unknown: float = 600.0
    batch: int = 1
    share: float = 0.02
    least: float = 5.0

    def silence(self, limit: float) -> float:
        """The seconds allowed besides the unit's own, in a run of ``limit`` seconds."""
        return min(self.floor, max(self.least, self.share * limit))

    def of_job(
        self, units: Iterable[Unit], pairs: int, costs: Costs, limit: float, allowance: float | None
    ) -> float:
        """Seconds of silence allowed to a job; ``allowance``: those to explore in, ``None`` if all is known."""
        factor = self.factor * min(pairs, self.batch)
        known = max(costs.longest(unit.name, factor) for unit in units)
        unknown = 0.0 if allowance is None else min(self.unknown, allowance)
        return self.silence(limit) + known + unknown

    def of_scene(self, seconds: float, limit: float) -> float:
        """Seconds that a reconstruction may take of which ``seconds`` are expected."""
        return self.silence(limit) + self.factor * seconds
