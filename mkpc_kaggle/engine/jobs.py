"""What crosses between the engine and a worker: three kinds of job, and their answers. Plain values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.reconstruct import Solution
from mkpc_kaggle.scene.view_graph import BatchPair


class Phase(StrEnum):
    """The phases of a run, in order."""

    ESTIMATE = "estimate"  # F anew, of the points that the journal has, where another estimation made it
    SWEEP = "sweep"  # the first unit on all pairs
    CONNECT = "connect"  # the first unit on pairs that no row names, where a batch has few
    DEEPEN = "deepen"  # the other units, as many as fit
    FILL = "fill"  # units that did not fit for all, on the weakest pairs first, in the time that is left


@dataclass(frozen=True)
class MatchJob:
    """Run ``units`` on the pairs of ``indices``; what a pair has had, ``known``, is left out.

    A job without units makes F of what is known alone: no image is read for it.

    ``expected`` are the seconds within which each unit most likely ends on a pair. Units may begin in the first
    ``seconds`` of the job if they are expected to end in them. After ``time_limit`` seconds without an answer the
    worker hangs. ``is_retry``: a worker was lost at it before.
    """

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...]
    expected: tuple[float, ...]
    seconds: float
    time_limit: float
    is_retry: bool = False
    pairs: tuple[Pair, ...] = ()
    known: tuple[PairMatch, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneJob:
    """Reconstruct a batch: ``indices`` are those of its ``pairs`` in the run; images go by their digests.

    ``unit_results`` are those of its :class:`SceneRecord`. ``export``: write COLMAP's files. The answer is a
    :class:`Solution`, whose choices are in the order of the pairs.
    """

    batch: str
    indices: tuple[int, ...]
    pairs: tuple[BatchPair, ...]
    recipe: Recipe
    unit_results: int = 0
    export: Export | None = None


@dataclass(frozen=True, eq=False)
class TaskJob:
    """Something to be known of images before there are pairs, under a ``key``: the bytes that ``do`` returns."""

    key: str
    do: Callable[[], bytes]


Job = MatchJob | SceneJob | TaskJob


@dataclass(frozen=True)
class Loaded:
    """A worker's first answer: it is ready for a job."""


@dataclass(frozen=True)
class Outcome:
    """What a job made of a pair: its record, and the new results that later jobs may build on."""

    record: PairRecord
    results: tuple[UnitResult, ...] = ()


@dataclass(frozen=True)
class MatchResult:
    """The outcomes of a match job, in the order of its pairs."""

    outcomes: tuple[Outcome, ...]

    @property
    def results(self) -> list[UnitResult]:
        """Of every unit that this job ran on a pair."""
        return [result for outcome in self.outcomes for result in outcome.results]

    @property
    def unit_seconds(self) -> float:
        return sum(result.seconds for result in self.results)


class Cause(StrEnum):
    """Why a worker has no result."""

    NOT_STARTED = "the worker could not be started"
    REFUSED = "the matchers cannot be loaded"
    DIED = "the worker died"
    TIMED_OUT = "the worker hung"
    DEVICE = "the device failed"
    OUT_OF_MEMORY = "out of memory"
    RAISED = "the worker failed"

    @property
    def is_of_place(self) -> bool:
        """Whether it counts against the place where the worker was, rather than against the units alone."""
        return self not in (Cause.OUT_OF_MEMORY, Cause.RAISED)


@dataclass(frozen=True)
class Failure:
    """The answer that a job came to nothing, or a worker to no job, and why."""

    cause: Cause
    message: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.message}" if self.message else str(self.cause)


Answer = Loaded | MatchResult | Solution | bytes | Failure


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Indices of pairs such that views of one image follow each other, and the encoding cache hits."""
    keys = [(pair.group, pair.file0, pair.file1) for pair in pairs]
    return sorted(range(len(pairs)), key=keys.__getitem__)
