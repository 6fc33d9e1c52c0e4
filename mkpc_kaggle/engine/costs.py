"""Costs of units on a pair, as measured during the run."""

from collections import deque
from collections.abc import Iterable
from math import sqrt
from statistics import fmean

from mkpc_kaggle.recipe import Unit

WINDOW = 64  # the number of the latest measurements that count
MARGIN, MIN_MARGIN = 0.4, 0.01  # of a forecast from one measurement; from n, sqrt(n) times smaller


class Costs:
    """Seconds of a unit on a pair, by name.

    A worker's first run of a unit is its warm-up. It counts until another run is measured, and in no forecast.
    """

    def __init__(self) -> None:
        self._measured: dict[str, deque[float]] = {}
        self._warm_up: dict[str, float] = {}

    def observe(self, unit: str, seconds: float, *, warm_up: bool = False) -> None:
        if warm_up:
            self._warm_up[unit] = seconds
        else:
            self._measured.setdefault(unit, deque(maxlen=WINDOW)).append(seconds)

    def has_run(self, unit: str) -> bool:
        return unit in self._measured or unit in self._warm_up

    def is_known(self, unit: str) -> bool:
        """Whether more than the warm-up is known."""
        return unit in self._measured

    def mean(self, unit: str) -> float:
        """Return the expected seconds on a pair; 0 if nothing is known."""
        if unit in self._measured:
            return fmean(self._measured[unit])
        return self._warm_up.get(unit, 0.0)

    def forecast(self, unit: str) -> float:
        """Return the expected seconds with a margin that shrinks as more is known; 0 while nothing is."""
        if not self.is_known(unit):
            return 0.0
        return self.mean(unit) * (1 + max(MIN_MARGIN, MARGIN / sqrt(len(self._measured[unit]))))

    def warm_up(self, units: Iterable[Unit]) -> float:
        """Return the seconds of the longest of these units' latest first runs on a worker."""
        return max((self._warm_up.get(unit.name, 0.0) for unit in units), default=0.0)
