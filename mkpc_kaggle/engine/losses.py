"""What a lost job means: halve it, take its units apart, shrink them, give them up."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from mkpc_kaggle.engine.jobs import Cause, Lost, Record, Stretch
from mkpc_kaggle.recipe import Unit

SHRINK, LEAST_SHRINK = 0.7, 0.45
"""A unit that a worker fails at on one pair is tried on views whose sides are 0.7, then 0.49 times as long."""
MOST_LOSSES = 4
"""A pair that cost that many jobs of its own is left alone."""
DEVICE_TRIES = 2
"""A pair at which, on its own, a device failed that often is left alone, but by this run only: a later one may do
better."""
HOPELESS = 3
"""A unit that workers failed at on that many pairs and never ran is given up on all."""


@dataclass(frozen=True)
class Verdict:
    """What to do after a loss: what to try ``again``, the units ``given_up`` on the job's only pair, and why.

    ``aside``: this run leaves the pair alone, and nothing of that is kept for later ones.
    """

    again: tuple[Stretch, ...] = ()
    given_up: tuple[Unit, ...] = ()
    reasons: tuple[str, ...] = ()
    aside: bool = False


class Losses:
    """Who lost how many jobs; ``hopeless`` are the names of units that are given up on all pairs."""

    def __init__(self) -> None:
        self.hopeless: set[str] = set()
        self._proven: set[str] = set()
        self._of_pair: Counter[int] = Counter()
        self._blamed: dict[str, set[int]] = {}

    def prove(self, units: Iterable[Unit]) -> None:
        """These have run on some pair: what is lost with them is the pair's fault, or the machine's."""
        self._proven.update(unit.name for unit in units)

    def judge(self, lost: Lost, records: Sequence[Record], units: Sequence[Unit]) -> Verdict:
        """``records`` are those of all pairs, ``units`` the recipe's."""
        plan = lost.job.plan
        stretch = Stretch(plan.phase, plan.indices, plan.units, plan.shrink)
        if lost.cause.blameless:
            return Verdict((stretch,))
        if len(plan.indices) > 1:
            half = len(plan.indices) // 2
            return Verdict(
                (replace(stretch, indices=plan.indices[:half]), replace(stretch, indices=plan.indices[half:]))
            )
        if lost.cause is Cause.DEVICE:
            return self._judge_device(stretch, lost)
        record = records[plan.indices[0]]
        lacking = sorted(record.lacking(plan.units), key=lambda unit: unit.stage)
        if len(lacking) > 1:  # stage 1 first: the critical regions depend on it
            return Verdict(tuple(replace(stretch, units=(unit,)) for unit in lacking))
        return self._judge_unit(replace(stretch, units=(lacking[0],)), lacking[0], lost, record.lacking(units))

    def _judge_device(self, stretch: Stretch, lost: Lost) -> Verdict:
        """The device failed at a single pair."""
        (index,) = stretch.indices
        self._of_pair[index] += 1
        if self._of_pair[index] < DEVICE_TRIES:
            return Verdict((stretch,))
        return Verdict(reasons=(f"pair {index} is left alone by this run ({lost})",), aside=True)

    def _judge_unit(self, stretch: Stretch, unit: Unit, lost: Lost, lacking: Sequence[Unit]) -> Verdict:
        """A single unit was lost on a single pair, which lacks that unit and maybe others."""
        (index,) = stretch.indices
        self._of_pair[index] += 1
        self._blamed.setdefault(unit.name, set()).add(index)
        reasons: tuple[str, ...] = ()
        if len(self._blamed[unit.name]) >= HOPELESS and unit.name not in self._proven | self.hopeless:
            self.hopeless.add(unit.name)
            reasons = (f"{unit.name} is given up: workers failed at it on {HOPELESS} pairs ({lost})",)
        if self._of_pair[index] >= MOST_LOSSES:
            told = f"pair {index} is left alone after {MOST_LOSSES} lost jobs ({lost})"
            return Verdict((), tuple(lacking), (*reasons, told))
        if lost.cause is Cause.RAISED or stretch.shrink * SHRINK < LEAST_SHRINK:
            return Verdict((), (unit,), (*reasons, f"{unit.name} is given up on pair {index} ({lost})"))
        return Verdict((replace(stretch, shrink=stretch.shrink * SHRINK),), (), reasons)
