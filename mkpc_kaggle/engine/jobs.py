"""Messages between the loop and its workers: four kinds of jobs, their answers, and failures.

Messages are pickled, so none has a connection, a lock, or a large array that the worker can read
itself.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.store.database import Source
from mkpc_kaggle.engine.store.keys import Images
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.geometry.robust import NO_STATS, EstimateStats
from mkpc_kaggle.pipeline.pair import Regions, UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.sfm import Solution


class Phase(IntEnum):
    """Priorities of matching, the most urgent first."""

    # The first unit of stage 1 that can run, on all pairs
    SWEEP = 0
    # The same unit on extra pairs, of batches with few pairs
    CONNECT = 1
    # The longest prefix of the recipe's units with enough time for all pairs
    DEEPEN = 2
    # The remaining units, weakest pairs first
    FILL = 3
    # The unit does not fit in the time left, or its points are already today's
    NEVER = 4

    def __str__(self) -> str:
        return self.name.lower()


@dataclass(frozen=True, eq=False)
class MatchPlan:
    """The schedule's choice: missing ``units`` on the pairs at ``indices``, one or a minibatch.

    ``expected`` are the expected seconds of each unit per pair. A unit begins only if it is expected to
    end within ``seconds`` of the job's start. ``is_last`` states that its pairs need no other units in
    this phase, ``is_check`` that the work is done already: the answer shows that the place works, and is
    not used.
    """

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...]
    expected: tuple[float, ...]
    seconds: float
    is_last: bool = True
    is_check: bool = False

    @property
    def items(self) -> tuple[tuple[Hashable, ...], ...]:
        """The units of pairs that a loss of this job concerns."""
        return tuple(("unit", index, unit.name) for index in self.indices for unit in self.units)


@dataclass(frozen=True, eq=False)
class MatchJob(MatchPlan):
    """A plan with its inputs, made by :meth:`mkpc_kaggle.engine.matching.Matching.job`.

    ``stage_1`` are each pair's points of stage 1, for critical regions, and ``crops`` their keys.
    ``upcoming`` are the images that will probably be matched next.
    """

    pairs: tuple[Pair, ...] = ()
    names: tuple[tuple[str, str], ...] = ()
    stage_1: tuple[tuple[UnitResult, ...], ...] = ()
    crops: tuple[tuple[str, ...], ...] = ()
    upcoming: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class PairInputs:
    """Inputs of a pair's estimate or of a scene: its images, and the keys of its points by unit.

    The units are in the recipe's order. ``own`` is for a scene: F from the pair's own matches.
    """

    index: int
    images: Images
    points: Mapping[Unit, str]
    # An E is estimated if both are known.
    intrinsics: tuple[Matrix3, Matrix3] | None = None
    own: Matrix3 | None = None


@dataclass(frozen=True, eq=False)
class EstimateJob:
    """Estimate F of each pair, or E if the pair has intrinsics."""

    pairs: tuple[PairInputs, ...]
    recipe: Recipe
    source: Source

    @property
    def items(self) -> tuple[tuple[Hashable, ...], ...]:
        return tuple(("estimate", pair.index) for pair in self.pairs)


@dataclass(frozen=True, eq=False)
class SceneJob:
    """Reconstruct a batch, from ``matches`` matches. ``export`` is for COLMAP's files, ``cameras`` are
    the user's known cameras.

    A ``candidate`` other than the first has its own ``key``, and ``scene`` is the key of the first. A batch
    that has files is reconstructed as a whole, ``is_whole``, even by a job that writes none.

    The answer is a :class:`Solution`, with choices in the order of the pairs, which have
    ``contents``.
    """

    batch: str
    key: str
    pairs: tuple[PairInputs, ...]
    contents: tuple[str, ...]
    recipe: Recipe
    source: Source
    matches: int = 0
    export: Path | None = None
    cameras: Rows = ()
    candidate: str = ALL_UNITS
    scene: str = ""
    is_whole: bool = False
    # A crash of pycolmap counts against the batch, not against its place.
    items: tuple[tuple[Hashable, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class FeatureJob:
    """Compute features of an image or of a folder by calling ``do``: bytes, or a JSON value."""

    key: str
    do: Callable[[], Any]
    # An image that crashes its decoder counts against itself, not against the place.
    items: tuple[tuple[Hashable, ...], ...] = ()


Job = MatchJob | EstimateJob | SceneJob | FeatureJob


@dataclass(frozen=True)
class Loaded:
    """A worker's first answer: the worker is ready for jobs.

    ``refused`` has the reason for each matcher that could not be loaded.
    """

    refused: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a match job on one pair. ``failure`` names an unreadable image.

    ``images`` have the digests of the matched contents, and ``files`` the size in bytes and the time of change in
    nanoseconds of each file before it was read.
    """

    images: Images | tuple[()] = ()
    files: tuple[tuple[int, int], ...] = ()
    results: tuple[UnitResult, ...] = ()
    regions: Regions | None = None
    failure: str = ""
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Estimated:
    """The estimate of a pair from the points with these keys; ``inliers`` has a count for each key."""

    points: tuple[str, ...]
    inliers: tuple[int, ...]
    F: Matrix3
    failure: str = ""
    magsac: Matrix3 | None = None
    stats: EstimateStats = NO_STATS
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Found:
    """The answer to a feature job."""

    value: Any


class Cause(StrEnum):
    """Cause of a missing result."""

    NOT_STARTED = "the worker could not be started"
    REFUSED = "the matchers cannot be loaded"
    DIED = "the worker died"
    TIMED_OUT = "the worker hung"
    DEVICE = "the device failed"
    OUT_OF_MEMORY = "out of memory"
    RAISED = "the worker failed"
    UNIT_RAISED = "the matcher failed"
    UNREADABLE = "an image cannot be read"


@dataclass(frozen=True)
class Failure:
    """The answer when a job failed or a worker cannot take jobs, with the cause."""

    cause: Cause
    message: str = ""

    def __str__(self) -> str:
        return f"{self.cause}: {self.message}" if self.message else str(self.cause)


# The answer to a match job or an estimate job has a value for each pair, in the order of the job.
Answer = Loaded | tuple[Outcome, ...] | tuple[Estimated, ...] | Solution | Found | Failure
