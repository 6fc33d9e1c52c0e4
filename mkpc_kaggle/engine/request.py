"""The request of a run, the messages between its loop and the workers, and its final report.

Messages are pickled, so none has a connection, a lock, or a large array that the worker can read itself.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.keys import Images, Keys
from mkpc_kaggle.engine.store import Source
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.candidates import title_of
from mkpc_kaggle.scene.sfm import Solution

if TYPE_CHECKING:
    from mkpc_kaggle.engine.state import State


class Ending(StrEnum):
    """Why a run ended, in a report."""

    COMPLETE = "complete"
    # Something was given up. All else is complete, and the next run tries it again.
    WITH_FAILURES = "ended with failures"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"
    NOTHING_RUNS = "every unit was skipped"
    NOT_ENDED = "not ended (at work, or killed)"

    @property
    def is_done(self) -> bool:
        """Whether the run has computed everything that it could."""
        return self in (Ending.COMPLETE, Ending.WITH_FAILURES)


@dataclass
class About:
    """Facts for reports about the run that wrote the store, so far.

    ``resumed`` is the number of pairs that earlier runs finished. ``faults`` are lost jobs, places and units that
    were closed, and unwritten files. ``failures`` are the reasons of batches that were given up.
    """

    # The table of a recipe's file, and the recipe's name
    recipe: dict[str, Any] = field(default_factory=dict)
    device: str = ""
    left_out: Sequence[str] = ()  # matchers that did not run, by cause
    # Of the package and its main dependencies
    versions: dict[str, str] = field(default_factory=dict)
    # The images of each dataset of a folder, by batch, also those in no pair
    files: dict[str, Sequence[str]] = field(default_factory=dict)
    ending: Ending = Ending.NOT_ENDED
    seconds: float = 0.0
    resumed: int = 0
    units_run: int = 0
    estimated: int = 0
    faults: list[str] = field(default_factory=list)
    failures: Sequence[str] = ()
    unwritten: str = ""  # why the last version of the results could not be written
    unsaved: str = ""  # why the journal does not have all results


@dataclass(frozen=True)
class Request:
    """A request for points, estimates and scenes of ``pairs``, whose images are below ``root``.

    ``cameras`` are the user's known cameras. With ``scenes_dir``, a batch is reconstructed as a whole, and
    each scene has COLMAP's files in a folder there, named by its key. ``publish`` is called with the state, whose
    ``written`` and ``scenes`` are the results so far: at the start, every half minute (less often if slow),
    after each scene with files, and at the end.
    """

    pairs: Sequence[Pair]
    recipe: Recipe
    keys: Keys
    root: str = ""
    cameras: Rows = ()
    scenes_dir: Path | None = None
    about: About = field(default_factory=About)
    publish: "Callable[[State], None]" = lambda _: None


# Messages


@dataclass(frozen=True, eq=False)
class PairInputs:
    """Inputs of a job on a pair: its images, and the keys of its points by unit, in the recipe's order.

    ``own`` is the F of its own matches, for a scene.
    """

    index: int
    pair: Pair
    images: Images
    points: Mapping[Unit, str]
    own: Matrix3 | None = None


def keys_of(pairs: Iterable[PairInputs]) -> list[str]:
    """Return the keys of all points of these pairs."""
    return [key for pair in pairs for key in pair.points.values()]


@dataclass(frozen=True, eq=False)
class Job:
    """Work on some pairs. Their points are in ``source``."""

    pairs: tuple[PairInputs, ...]
    recipe: Recipe
    source: Source

    @property
    def indices(self) -> list[int]:
        return [pair.index for pair in self.pairs]


@dataclass(frozen=True)
class MatchPlan:
    """Missing ``units`` on ``pairs``, one or a minibatch, by their numbers.

    ``expected`` are the seconds of each unit on a pair. A unit begins only if it is expected to end within
    ``seconds`` of the job's start. ``upcoming`` are the pairs that will probably follow.
    """

    phase: int
    pairs: list[int]
    units: list[int]
    expected: list[float]
    seconds: float
    upcoming: list[int]


@dataclass(frozen=True, eq=False)
class MatchJob(Job):
    """Run the units of a plan, in the recipe's order. The pairs have the points that their crops come from,
    besides the job's own. ``upcoming`` are the images that will probably be matched next.
    """

    plan: MatchPlan
    upcoming: Sequence[Path] = ()

    @property
    def units(self) -> list[Unit]:
        return [self.recipe.units[number] for number in self.plan.units]


@dataclass(frozen=True, eq=False)
class EstimateJob(Job):
    """Estimate F of each pair."""


@dataclass(frozen=True, eq=False)
class SceneJob(Job):
    """Reconstruct a batch from ``matches`` matches, with COLMAP's files in ``folder``, if any.

    ``scene`` are the numbers of the batch and of the candidate, which has its own ``key``. The answer is a
    :class:`Solution`, with choices in the order of the pairs.
    """

    scene: tuple[int, int]
    batch: str
    candidate: str
    key: str
    matches: int = 0
    folder: Path | None = None
    cameras: Rows = ()

    def __str__(self) -> str:
        tracks = f" by the tracks of {title_of(self.candidate)}" if self.candidate else ""
        return f"batch {self.batch}{tracks}"


@dataclass(frozen=True)
class Loaded:
    """A worker's first answer: it is ready. ``refused`` has the reason for each matcher that could not be
    loaded.
    """

    refused: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Estimated:
    """The estimate of a pair as facts for the store, see :meth:`mkpc_kaggle.pipeline.pair.PairMatch.facts`."""

    facts: Mapping[str, Any]
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
        return f"{self.cause}: {self.message}".removesuffix(": ")


# The answer to a match job or an estimate job has a value for each pair, in the order of the job. A matched
# pair has the results of its job, and no images; its ``failure`` names an unreadable or changed image.
Answer = Loaded | tuple[PairMatch, ...] | tuple[Estimated, ...] | Solution | Failure
