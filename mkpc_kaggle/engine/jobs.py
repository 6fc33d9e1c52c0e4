"""Messages between the engine and its workers: four kinds of jobs and their answers; the record of lost jobs."""

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Generic, TypeVar

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions, UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.reconstruct import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

MAX_TRIES = 2  # of an item in its own job

Item = TypeVar("Item", bound=Hashable)


class Phase(IntEnum):
    """Priorities of matching, the most urgent first."""

    SWEEP = 0  # the first unit on all pairs
    CONNECT = 1  # the first unit on extra pairs of batches with few pairs
    DEEPEN = 2  # the longest prefix of the recipe's units with enough time for all pairs
    FILL = 3  # the remaining units, weakest pairs first
    NEVER = 4

    def __str__(self) -> str:
        return self.name.lower()


@dataclass(frozen=True)
class WantedPair:
    """A pair of the request, with the names of its images and the digest of its estimate's settings."""

    pair: Pair
    names: tuple[str, str]
    settings: str
    has_row: bool = True


@dataclass(frozen=True)
class MatchJob:
    """Run missing ``units`` on the pairs at ``indices``: one pair, or a minibatch on a GPU.

    ``expected`` are the expected seconds of each unit per pair. A unit begins only if it is expected to end within
    ``seconds`` of the job's start. ``known`` are each pair's points of stage 1, for critical regions. ``upcoming``
    are the images that will probably be matched next. ``is_retry`` states that the work lost a worker before.
    """

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...]
    expected: tuple[float, ...]
    seconds: float
    is_retry: bool = False
    pairs: tuple[WantedPair, ...] = ()
    known: tuple[tuple[UnitResult, ...], ...] = ()
    upcoming: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class PairPoints:
    """References to a pair's current points: each unit with its row's revision, in the recipe's order."""

    index: int
    images: tuple[BatchImage, BatchImage]
    units: tuple[tuple[Unit, int], ...]
    intrinsics: tuple[Matrix3, Matrix3] | None = None
    own: Matrix3 | None = None  # for a scene: F from the pair's own matches

    @property
    def revisions(self) -> tuple[int, ...]:
        return tuple(revision for _, revision in self.units)


PointSource = Path | dict[int, Matches]  # the journal's directory, or the points by revision


@dataclass(frozen=True, eq=False)
class EstimateJob:
    """Estimate F of each pair, or E if the pair has intrinsics."""

    pairs: tuple[PairPoints, ...]
    recipe: Recipe
    source: PointSource
    is_retry: bool = False


@dataclass(frozen=True, eq=False)
class SceneJob:
    """Reconstruct a batch from ``matches`` matches of the revisions ``inputs``. ``export`` is for COLMAP's files.

    The answer is a :class:`Solution`, with choices in the order of the pairs.
    """

    batch: str
    pairs: tuple[PairPoints, ...]
    recipe: Recipe
    source: PointSource
    inputs: str = ""
    matches: int = 0
    export: Path | None = None
    is_retry: bool = True  # a crash of pycolmap counts against the batch, not against its place


@dataclass(frozen=True)
class LookJob:
    """Compute the features of an image or of a dataset, as bytes, by calling ``do``."""

    key: tuple[str, str]  # digest of the contents, digest of the settings
    do: Callable[[], bytes]
    is_retry: bool = True


Job = MatchJob | EstimateJob | SceneJob | LookJob


@dataclass(frozen=True)
class Loaded:
    """A worker's first answer: the worker is ready for jobs."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a job for a pair, as rows of the table ``points``. ``failure`` names an unreadable image."""

    index: int
    images: tuple[BatchImage, ...] = ()
    found: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    failure: str = ""
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Estimated:
    """The estimate of a pair from the point revisions ``inputs``; ``inliers`` has a count for each revision."""

    index: int
    inputs: tuple[int, ...]
    inliers: tuple[int, ...]
    F: Matrix3
    failure: str = ""
    magsac: Matrix3 | None = None
    stats: EstimateStats = NO_STATS
    seconds: float = 0.0


class Cause(StrEnum):
    """Cause of a missing result."""

    NOT_STARTED = "the worker could not be started"
    REFUSED = "the matchers cannot be loaded"
    DIED = "the worker died"
    TIMED_OUT = "the worker hung"
    DEVICE = "the device failed"
    OUT_OF_MEMORY = "out of memory"
    RAISED = "the worker failed"


@dataclass(frozen=True)
class Failure:
    """The answer when a job failed or a worker cannot take jobs, with the cause."""

    cause: Cause
    message: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.message}" if self.message else str(self.cause)


class Losses(Generic[Item]):
    """Items of lost jobs. Each is retried in its own job, and skipped when that job is lost for the second time.

    ``alone`` are the items to retry in their own jobs. ``skipped`` has the failure of each skipped item.
    """

    def __init__(self) -> None:
        self.alone: set[Item] = set()
        self.skipped: dict[Item, Failure] = {}
        self._tries: Counter[Item] = Counter()

    def add(self, lost: Sequence[Item], failure: Failure) -> bool:
        """Record the items of a lost job. Return whether it had a single item, which is now skipped."""
        self.alone.update(lost)
        if len(lost) != 1:
            return False
        self._tries[lost[0]] += 1
        if self._tries[lost[0]] < MAX_TRIES:
            return False
        self.skipped[lost[0]] = failure
        return True


# The answer to a match job or an estimate job has a value for each pair, in order.
Answer = Loaded | tuple[Outcome, ...] | tuple[Estimated, ...] | Solution | bytes | Failure


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Return pair indices in an order that puts pairs with a common image together, for encoding cache hits."""
    keys = [(pair.group, pair.file0, pair.file1) for pair in pairs]
    return sorted(range(len(pairs)), key=keys.__getitem__)
