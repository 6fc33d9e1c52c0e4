"""Jobs: what a worker gets and what comes back. Plain values, so that they can cross processes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit

JOB_PAIRS = 8
"""Pairs in a job: enough for a batch on a GPU, few enough to plan anew every some seconds."""


class Phase(StrEnum):
    """The passes of a run, in order."""

    SWEEP = "sweep"
    CONNECT = "connect"
    DEEPEN = "deepen"
    UPGRADE = "upgrade"


@dataclass(frozen=True)
class Chunk:
    """Pairs that wait for their turn; ``units`` None: as many as fit when it comes."""

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...] | None = None
    shrink: float = 1.0
    round: int = 0


@dataclass(frozen=True)
class Job:
    """``units`` to run on the pairs of ``indices``; those that a pair has had are left out.

    ``expected`` are the seconds within which each unit most likely ends on a pair. No unit is begun that is
    expected to end after ``deadline``, in seconds of the parent's clock. A worker that begins no unit and does not
    answer for ``timeout`` seconds hangs. The views' sides are ``shrink`` times as long as the units say.
    ``pairs`` and ``known``, what earlier jobs found on each, go along with it to the worker.
    """

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...]
    expected: tuple[float, ...]
    deadline: float
    timeout: float
    shrink: float = 1.0
    exploring: bool = False
    pairs: tuple[Pair, ...] = ()
    known: tuple[tuple[UnitResult, ...], ...] = ()

    @property
    def note(self) -> str:
        """What the units' records say of it; empty for units that run as they are written."""
        return f"ran at {self.shrink:.2g} of its size, the worker failed at more" if self.shrink < 1 else ""

    @property
    def images(self) -> Iterator[Path]:
        """The files that it needs."""
        return (path for pair in self.pairs for path in pair.images)


@dataclass(frozen=True)
class Outcome:
    """What a job made of one pair: its record, and the new results that later jobs may build on."""

    record: PairRecord
    results: tuple[UnitResult, ...] = ()


@dataclass(frozen=True)
class JobResult:
    """The outcomes of a job, one a pair, in order."""

    job: Job
    outcomes: tuple[Outcome, ...]

    @property
    def results(self) -> list[UnitResult]:
        """Those of every unit that this job ran on a pair."""
        return [result for outcome in self.outcomes for result in outcome.results]

    @property
    def unit_seconds(self) -> float:
        return sum(result.seconds for result in self.results)


class Cause(StrEnum):
    """Why a job failed."""

    DIED = "the worker died"
    HUNG = "the worker hung"
    OUT_OF_MEMORY = "out of memory"
    DEVICE = "the device failed"
    RAISED = "the worker failed"
    NO_WORKER = "no worker could be started"
    MACHINE = "the machine was lost"

    @property
    def blameless(self) -> bool:
        """It says nothing against the job."""
        return self in (Cause.NO_WORKER, Cause.MACHINE)


@dataclass(frozen=True)
class JobFailure:
    """A job that brought nothing, and why."""

    job: Job
    cause: Cause
    message: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.message}" if self.message else str(self.cause)


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Indices of pairs such that views of one image follow each other, and the encoding cache hits."""
    return sorted(
        range(len(pairs)), key=lambda index: (pairs[index].group, pairs[index].file0, pairs[index].file1)
    )


def split(indices: Iterable[int]) -> Iterator[tuple[int, ...]]:
    """One index alone, so that costs are known early, then :data:`JOB_PAIRS` at a time.

    The same for every run of the same pairs, whatever was done before: a batch's composition can move the
    last bits of a network's output.
    """
    indices = list(indices)
    if indices:
        yield (indices[0],)
    for start in range(1, len(indices), JOB_PAIRS):
        yield tuple(indices[start : start + JOB_PAIRS])
