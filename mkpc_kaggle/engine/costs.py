"""What units cost on a pair, as measured during the run, and what all pairs therefore need."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from math import sqrt

from mkpc_kaggle.recipe import Unit

WINDOW = 64  # how many of the latest measurements count
MIN_MEASUREMENTS = 4  # of a unit that is left out: on a single pair it may take many times what it takes on others
MARGIN, MIN_MARGIN = 0.4, 0.01  # of a forecast from one measurement; from n, sqrt(n) times smaller
STALL_FACTOR = 10.0  # a measurement this many times the upper quartile is a stall, and counts as no more


class Measurements:
    """The latest measurements of a quantity, in seconds: their ``mean``, stalls cut, and 90th percentile."""

    def __init__(self, *seconds: float) -> None:
        self.count = 0
        self.mean = self.p90 = 0.0
        self._latest: deque[float] = deque(maxlen=WINDOW)
        for value in seconds:
            self.add(value)

    def add(self, seconds: float) -> None:
        self._latest.append(seconds)
        self.count += 1
        ranked = sorted(self._latest)
        # Encodings are cached, so a unit costs much on some pairs and little on others: a median would forecast
        # too little. Only what no cache explains is cut.
        stall = STALL_FACTOR * ranked[3 * len(ranked) // 4]
        self.mean = sum(min(value, stall) for value in ranked) / len(ranked) if stall > 0 else ranked[-1]
        self.p90 = ranked[9 * len(ranked) // 10]


UNKNOWN = Measurements()


class Costs:
    """What units cost on a pair, in seconds.

    A worker's first run of a unit is its warm-up, which says nothing of the pairs to come: it counts only as long
    as nothing else was measured, and in no forecast.
    """

    def __init__(self) -> None:
        self._measured: dict[str, Measurements] = {}
        self._assumed: dict[str, Measurements] = {}
        self._warm_up: dict[str, Measurements] = {}
        self._overhead = Measurements()

    def observe(self, unit: str, seconds: float, *, warm_up: bool = False) -> None:
        self._assumed.pop(unit, None)
        if warm_up:
            self._warm_up[unit] = Measurements(seconds)
        else:
            self._measured.setdefault(unit, Measurements()).add(seconds)

    def observe_overhead(self, seconds: float) -> None:
        """Seconds of a worker that a pair took besides its units."""
        self._overhead.add(seconds)

    def assume(self, unit: str, seconds: float) -> None:
        """A unit that did not end within these seconds costs at least as much, until it is measured."""
        if not self.has_run(unit):
            self._assumed.setdefault(unit, Measurements(seconds))

    def has_run(self, unit: str) -> bool:
        return unit in self._measured or unit in self._warm_up

    def is_known(self, unit: str) -> bool:
        """Whether more than its warm-up is known."""
        return unit in self._measured or unit in self._assumed

    def mean(self, unit: str) -> float:
        """Expected seconds on a pair; 0 for a unit of which nothing is known."""
        return (self._steady(unit) or self._warm_up.get(unit, UNKNOWN)).mean

    def p90(self, unit: str) -> float:
        """Seconds within which the unit ends on nine of ten pairs."""
        return (self._steady(unit) or self._warm_up.get(unit, UNKNOWN)).p90

    def hang_after(self, unit: str, factor: float) -> float:
        """Seconds after which the unit hangs: its warm-up, as on a new worker, and ``factor`` times its cost."""
        return self._warm_up.get(unit, UNKNOWN).p90 + factor * (self._steady(unit) or UNKNOWN).p90

    def forecast(self, unit: str) -> float:
        """Expected seconds with a margin that shrinks as more is known; 0 as long as nothing is."""
        known = self._steady(unit)
        return known.mean * (1 + max(MIN_MARGIN, MARGIN / sqrt(known.count))) if known else 0.0

    def is_sure(self, unit: str) -> bool:
        """Whether enough is known of a unit to leave it out."""
        return unit in self._assumed or self._measured.get(unit, UNKNOWN).count >= MIN_MEASUREMENTS

    @property
    def overhead(self) -> float:
        return max(0.0, self._overhead.mean)

    def cumulative(self, units: Sequence[Unit], lacking: Mapping[str, int]) -> Iterator[float]:
        """The seconds that it takes to give all pairs the first unit, the first two, and so on.

        ``lacking[name]`` is the number of pairs that have not had that unit yet.
        """
        needed = self.overhead * max((lacking[unit.name] for unit in units), default=0)
        for unit in units:
            needed += self.forecast(unit.name) * lacking[unit.name]
            yield needed

    def _steady(self, unit: str) -> Measurements | None:
        return self._measured.get(unit) or self._assumed.get(unit)
