"""What a failed job means: halve it, take its units apart, shrink their views, give them up."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from mkpc_kaggle.engine.jobs import Cause, Chunk, JobFailure
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.recipe import Unit

SHRINK, LEAST_SHRINK = 0.7, 1.0
"""A unit that a worker fails at on one pair is tried on views whose sides are 0.7, then 0.49 times as long."""
MOST_FAILURES = 4
"""A pair at which that many jobs of its own failed is left alone."""
DEVICE_TRIES = 2
"""A pair at which, on its own, a device failed that often is left alone, but by this run only: a later one may do
better."""
MOST_PAIRS = 3
"""A unit that workers failed at on that many pairs and never ran is given up on all."""


@dataclass(frozen=True)
class Retry:
    """What follows a failure: the chunks to try again, the units to give up on the job's only pair, and why.

    ``leave_pair``: this run leaves the pair alone, and nothing of that is kept for later ones.
    """

    chunks: tuple[Chunk, ...] = ()
    give_up: tuple[Unit, ...] = ()
    reasons: tuple[str, ...] = ()
    leave_pair: bool = False


class Retries:
    """Which jobs failed at what; ``unusable`` are the names of units that are given up on all pairs."""

    def __init__(self) -> None:
        self.unusable: set[str] = set()
        self._proven: set[str] = set()
        self._failures: Counter[int] = Counter()
        self._failed_at: dict[str, set[int]] = {}

    def prove(self, units: Iterable[Unit]) -> None:
        """These have run on some pair: where they fail it is the pair's fault, or the machine's."""
        self._proven.update(unit.name for unit in units)

    def after(self, failure: JobFailure, records: Sequence[PairRecord], units: Sequence[Unit]) -> Retry:
        """What to do next; ``records`` are those of all pairs, ``units`` the recipe's."""
        job = failure.job
        chunk = Chunk(job.phase, job.indices, job.units, job.shrink)
        if failure.cause.blameless:
            return Retry((chunk,))
        if len(job.indices) > 1:
            half = len(job.indices) // 2
            return Retry(tuple(replace(chunk, indices=part) for part in (job.indices[:half], job.indices[half:])))
        if failure.cause is Cause.DEVICE:
            return self._after_device(chunk, failure)
        record = records[job.indices[0]]
        lacking = sorted(record.lacking(job.units), key=lambda unit: unit.stage)
        if len(lacking) > 1:  # stage 1 first: the critical regions depend on it
            return Retry(tuple(replace(chunk, units=(unit,)) for unit in lacking))
        return self._after_unit(replace(chunk, units=(lacking[0],)), lacking[0], failure, record.lacking(units))

    def _after_device(self, chunk: Chunk, failure: JobFailure) -> Retry:
        """The device failed at a single pair."""
        (index,) = chunk.indices
        self._failures[index] += 1
        if self._failures[index] < DEVICE_TRIES:
            return Retry((chunk,))
        return Retry(reasons=(f"pair {index} is left alone by this run ({failure})",), leave_pair=True)

    def _after_unit(self, chunk: Chunk, unit: Unit, failure: JobFailure, lacking: Sequence[Unit]) -> Retry:
        """A single unit failed on a single pair, which lacks that unit and maybe others."""
        (index,) = chunk.indices
        self._failures[index] += 1
        self._failed_at.setdefault(unit.name, set()).add(index)
        reasons: tuple[str, ...] = ()
        if len(self._failed_at[unit.name]) >= MOST_PAIRS and unit.name not in self._proven | self.unusable:
            self.unusable.add(unit.name)
            reasons = (f"{unit.name} is given up: workers failed at it on {MOST_PAIRS} pairs ({failure})",)
        if self._failures[index] >= MOST_FAILURES:
            reason = f"pair {index} is left alone after {MOST_FAILURES} lost jobs ({failure})"
            return Retry((), tuple(lacking), (*reasons, reason))
        if failure.cause is Cause.RAISED or chunk.shrink * SHRINK < LEAST_SHRINK:
            return Retry((), (unit,), (*reasons, f"{unit.name} is given up on pair {index} ({failure})"))
        return Retry((replace(chunk, shrink=chunk.shrink * SHRINK),), (), reasons)
