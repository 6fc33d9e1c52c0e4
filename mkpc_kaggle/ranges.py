"""The ranges that numbers of a configuration must lie in, told in the notation of intervals."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any


@dataclass(frozen=True)
class Range:
    """Finite numbers from ``low`` to ``high``; ``bounds`` "[]", "(]", "[)" or "()" say which ends are in it."""

    low: float
    high: float = inf
    bounds: str = "[]"

    def __contains__(self, number: float) -> bool:
        above = number >= self.low if self.bounds[0] == "[" else number > self.low
        below = number <= self.high if self.bounds[1] == "]" else number < self.high
        return above and below and isfinite(number)

    def __str__(self) -> str:
        left, right = self.bounds[0], ")" if self.high == inf else self.bounds[1]
        return f"{left}{self.low:g}, {self.high:g}{right}"


AT_LEAST_0, AT_LEAST_1 = Range(0), Range(1)
POSITIVE = Range(0, bounds="(]")
SHARE = Range(0, 1)
"""Of a whole; also a score's range."""


def check_ranges(config: Any, **ranges: Range) -> None:
    """Raise ``ValueError`` for the first of these attributes of ``config`` that is out of its range."""
    for name, allowed in ranges.items():
        number = getattr(config, name)
        if number not in allowed:
            raise ValueError(f"{name} must be in {allowed}, not {number}")
