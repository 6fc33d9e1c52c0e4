"""When a worker is taken to hang."""

from collections.abc import Iterable
from dataclasses import dataclass

from mkpc_kaggle.engine.budget import Costs
from mkpc_kaggle.recipe import Unit


@dataclass(frozen=True)
class Patience:
    """A worker hangs that is silent for ``floor`` seconds and ``factor`` times what a unit should take.

    It is heard of before each unit on each ``batch`` of pairs. ``unknown`` seconds are allowed where nobody knows
    what a unit costs. A machine that is ten times slower of a sudden does not hang. A short run waits less: for
    ``share`` of its limit, but ``least`` seconds, in place of the floor; for an unknown unit as long as it may be
    explored.
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

    def timeout(
        self, units: Iterable[Unit], pairs: int, costs: Costs, limit: float, allowance: float | None
    ) -> float:
        """Seconds of silence allowed to a job; ``allowance``: those to explore in, ``None`` if all is known."""
        factor = self.factor * min(pairs, self.batch)
        known = max(costs.longest(unit.name, factor) for unit in units)
        unknown = 0.0 if allowance is None else min(self.unknown, allowance)
        return self.silence(limit) + known + unknown
