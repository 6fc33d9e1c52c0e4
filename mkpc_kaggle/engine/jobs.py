"""What the engine hands to a worker and what it gets back: plain values, so that they can cross processes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Matrix3
from mkpc_kaggle.pipeline.stages import PairMatch, Regions, UnitResult
from mkpc_kaggle.recipe import Unit

CHUNK = 8
"""Pairs in a job: enough for a batch on a GPU, few enough to plan anew every some seconds."""


NOT_REACHED = "not reached in time"


class Phase(StrEnum):
    """The passes of a run, in order."""

    SWEEP = "sweep"
    DEEPEN = "deepen"
    UPGRADE = "upgrade"


@dataclass(frozen=True)
class Stretch:
    """Pairs that will be worked on together, when their turn comes; ``units`` None: as many as fit then."""

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...] | None = None
    shrink: float = 1.0
    round: int = 0


@dataclass(frozen=True)
class Plan:
    """What to do next: ``units`` on the pairs of ``indices``, those that a pair has had left out.

    ``expected`` are the seconds within which each unit most likely ends on a pair. No unit is begun that is
    expected to end after ``deadline``, in seconds of the parent's clock. A worker that begins no unit and does not
    answer for ``timeout`` seconds hangs. The views' sides are ``shrink`` times as long as the units say.
    """

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...]
    expected: tuple[float, ...]
    deadline: float
    timeout: float
    shrink: float = 1.0
    exploring: bool = False

    @property
    def note(self) -> str:
        """What the units' records say of it; empty for units that run as they are written."""
        return f"ran at {self.shrink:.2g} of its size, the worker failed at more" if self.shrink < 1 else ""


@dataclass(frozen=True)
class Task:
    """One pair of a job, with what earlier jobs found on it."""

    index: int
    pair: Pair
    results: tuple[UnitResult, ...] = ()


@dataclass(frozen=True)
class Job:
    """A plan with its pairs: all that a worker is told."""

    plan: Plan
    tasks: tuple[Task, ...]


@dataclass(frozen=True, eq=False)
class Matched:
    """What a worker found on one task: the results of the units that it ran, without earlier ones.

    ``sizes`` are those of the images, ``None`` where one cannot be read; ``failure`` is empty, or says which.
    """

    results: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    sizes: tuple[Size, Size] | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    failure: str = ""


@dataclass(frozen=True)
class UnitRecord:
    """What the journal keeps of one unit on one pair."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str


@dataclass(frozen=True, eq=False)
class Record:
    """What is known of one pair: its F (its E, where the pair has intrinsics) and how it came about.

    ``failure`` is empty, or says why ``F`` is the fallback. The seconds are those of all jobs on the pair.
    ``before`` is the number of inliers that it had when it was first upgraded; ``None`` if it never was.
    """

    index: int
    F: Matrix3
    failure: str
    units: tuple[UnitRecord, ...] = ()
    regions: tuple[CriticalRegion, CriticalRegion] | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    before: int | None = None

    @classmethod
    def untouched(cls, index: int, reason: str = NOT_REACHED) -> "Record":
        return cls(index, FALLBACK_FUNDAMENTAL.copy(), reason)

    def after(self, former: "Record", before: int | None) -> "Record":
        """The record of a later job on a pair: with the seconds of the ``former`` ones, and their regions."""
        return replace(
            self,
            regions=self.regions or former.regions,
            decode_seconds=former.decode_seconds + self.decode_seconds,
            cluster_seconds=former.cluster_seconds + self.cluster_seconds,
            estimate_seconds=former.estimate_seconds + self.estimate_seconds,
            before=before,
        )

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED

    @property
    def inliers(self) -> int:
        return sum(unit.inliers for unit in self.units)

    @property
    def matches(self) -> int:
        return sum(unit.matches for unit in self.units)

    def has(self, unit: Unit) -> bool:
        return any(record.unit == unit.name for record in self.units)

    def lacking(self, units: Iterable[Unit]) -> list[Unit]:
        """Those of ``units`` that the pair has not had."""
        had = {record.unit for record in self.units}
        return [unit for unit in units if unit.name not in had]


@dataclass(frozen=True)
class Outcome:
    """What became of one task: the record to keep, and the new results that later jobs may build on."""

    record: Record
    results: tuple[UnitResult, ...] = ()


@dataclass(frozen=True)
class Finished:
    """The outcomes of a job, one a task, in order."""

    job: Job
    outcomes: tuple[Outcome, ...]

    def measured(self) -> list[tuple[str, float]]:
        """Unit name and seconds of every unit that this job ran on a pair."""
        return [(result.unit.name, result.seconds) for outcome in self.outcomes for result in outcome.results]


class Cause(StrEnum):
    """Why a job was lost."""

    DIED = "the worker died"
    HUNG = "the worker hung"
    OUT_OF_MEMORY = "out of memory"
    RAISED = "the worker failed"
    NO_WORKER = "no worker could be started"
    MACHINE = "the machine was lost"

    @property
    def blameless(self) -> bool:
        """It says nothing against the job."""
        return self in (Cause.NO_WORKER, Cause.MACHINE)


@dataclass(frozen=True)
class Lost:
    """A job that brought nothing, and why."""

    job: Job
    cause: Cause
    text: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.text}" if self.text else str(self.cause)


def record_of(index: int, match: PairMatch, *, decode: float, cluster: float, estimate: float) -> Record:
    """The record of a matched pair; the three are seconds."""
    starts = np.cumsum([0] + [len(result.matches) for result in match.results])
    return Record(
        index,
        match.estimate.matrix,
        match.estimate.failure,
        tuple(
            UnitRecord(
                result.unit.name,
                result.unit.stage,
                len(result.matches),
                int(match.estimate.inliers[start : start + len(result.matches)].sum()),
                result.encode_seconds,
                result.match_seconds,
                result.failure,
            )
            for result, start in zip(match.results, starts[:-1], strict=True)
        ),
        match.regions,
        decode,
        cluster,
        estimate,
    )


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Indices of pairs such that views of one image follow each other, and the encoding cache hits."""
    return sorted(range(len(pairs)), key=lambda index: (pairs[index].group, *map(str, pairs[index].images)))


def chunks(indices: Iterable[int]) -> Iterator[tuple[int, ...]]:
    """One index alone, so that costs are known early, then :data:`CHUNK` at a time.

    The same for every run of the same pairs, whatever was done before: a batch's composition can move the
    last bits of a network's output.
    """
    indices = list(indices)
    if indices:
        yield (indices[0],)
    for start in range(1, len(indices), CHUNK):
        yield tuple(indices[start : start + CHUNK])
