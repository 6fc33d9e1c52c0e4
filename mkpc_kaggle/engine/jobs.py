"""Messages between the engine and its workers: four kinds of job, their answers, and a record of lost jobs."""

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

MAX_TRIES = 2  # of an item alone

Item = TypeVar("Item", bound=Hashable)


class Phase(IntEnum):
    """The priorities of matching, in order."""

    SWEEP = 0  # the first unit on all pairs
    CONNECT = 1  # the first unit on extra pairs, where a batch has few pairs
    DEEPEN = 2  # the longest prefix of the recipe that fits for all pairs
    FILL = 3  # the other units, on the weakest pairs first
    NEVER = 4

    def __str__(self) -> str:
        return self.name.lower()


@dataclass(frozen=True)
class WantedPair:
    """A pair that a run asks for: names of its images, digest of its estimate's settings."""

    pair: Pair
    names: tuple[str, str]
    settings: str
    has_row: bool = True


@dataclass(frozen=True)
class MatchJob:
    """Run missing ``units`` on the pairs of ``indices``: one pair, or a minibatch on a GPU.

    ``expected`` are the seconds that each unit takes on a pair. A unit begins only if it is expected to end within
    ``seconds`` of the job's start. ``known`` are the points of stage 1 that critical regions are computed from.
    ``upcoming`` are the images that will probably be matched next. ``is_retry``: a worker was lost at it before.
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
    """References to a pair's current points: ``units`` with the revisions of their rows, in the recipe's order."""

    index: int
    images: tuple[BatchImage, BatchImage]
    units: tuple[tuple[Unit, int], ...]
    intrinsics: tuple[Matrix3, Matrix3] | None = None
    own: Matrix3 | None = None  # for a scene: the F of the pair's own matches

    @property
    def revisions(self) -> tuple[int, ...]:
        return tuple(revision for _, revision in self.units)


PointSource = Path | dict[int, Matches]  # the directory of the journal with the points, or the points by revision


@dataclass(frozen=True, eq=False)
class EstimateJob:
    """Estimate F, or E with intrinsics, of some pairs."""

    pairs: tuple[PairPoints, ...]
    recipe: Recipe
    source: PointSource
    is_retry: bool = False


@dataclass(frozen=True, eq=False)
class SceneJob:
    """Reconstruct a batch with ``matches`` from ``inputs``, revisions.

    ``export`` is a directory for COLMAP's files. The answer is a :class:`Solution`, with a choice for each pair.
    """

    batch: str
    pairs: tuple[PairPoints, ...]
    recipe: Recipe
    source: PointSource
    inputs: str = ""
    matches: int = 0
    export: Path | None = None
    is_retry: bool = True  # a crash of pycolmap counts against the batch and not against its place


@dataclass(frozen=True)
class LookJob:
    """Compute the features of an image, or of a dataset: the bytes that ``do`` returns."""

    key: tuple[str, str]  # digest of the contents, digest of the settings
    do: Callable[[], bytes]
    is_retry: bool = True


Job = MatchJob | EstimateJob | SceneJob | LookJob


@dataclass(frozen=True)
class Loaded:
    """A worker's first answer: it is ready for a job."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a job for a pair: rows of the table ``points``. ``failure`` says which image cannot be read."""

    index: int
    images: tuple[BatchImage, ...] = ()
    found: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    failure: str = ""
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Estimated:
    """The estimate of a pair from the points of ``inputs``; ``inliers`` are the numbers among each of these."""

    index: int
    inputs: tuple[int, ...]
    inliers: tuple[int, ...]
    F: Matrix3
    failure: str = ""
    magsac: Matrix3 | None = None
    stats: EstimateStats = NO_STATS
    seconds: float = 0.0


class Cause(StrEnum):
    """Why a worker has no result."""

    NOT_STARTED = "the worker could not be started"
    REFUSED = "the matchers cannot be loaded"
    DIED = "the worker died"
    TIMED_OUT = "the worker hung"
    DEVICE = "the device failed"
    OUT_OF_MEMORY = "out of memory"
    RAISED = "the worker failed"


@dataclass(frozen=True)
class Failure:
    """The answer that a job failed, or that a worker cannot take a job, and why."""

    cause: Cause
    message: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.message}" if self.message else str(self.cause)


class Losses(Generic[Item]):
    """Work that lost workers: its items are retried singly, and an item that is lost twice alone is skipped.

    ``alone`` are the items to try singly, ``skipped`` the failures of the items that are no longer tried.
    """

    def __init__(self) -> None:
        self.alone: set[Item] = set()
        self.skipped: dict[Item, Failure] = {}
        self._tries: Counter[Item] = Counter()

    def add(self, lost: Sequence[Item], failure: Failure) -> bool:
        """Record the items of a lost job. Return whether its single item is skipped from now on."""
        self.alone.update(lost)
        if len(lost) != 1:
            return False
        self._tries[lost[0]] += 1
        if self._tries[lost[0]] < MAX_TRIES:
            return False
        self.skipped[lost[0]] = failure
        return True


# A match job or an estimate job is answered by a value for each of its pairs, in order.
Answer = Loaded | tuple[Outcome, ...] | tuple[Estimated, ...] | Solution | bytes | Failure


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Return indices of pairs in which pairs that share an image are adjacent, so that the encoding cache hits."""
    keys = [(pair.group, pair.file0, pair.file1) for pair in pairs]
    return sorted(range(len(pairs)), key=keys.__getitem__)
