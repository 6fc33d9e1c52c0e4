"""The request of a run, and its final report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.store.dataframes import PairTables
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.engine.store.scene_record import SceneRecord
from mkpc_kaggle.engine.store.tables import About, Event
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.scene.export import HeldDirectory

if TYPE_CHECKING:
    from mkpc_kaggle.engine.plan.state import State


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    # Something was given up. All else is complete, and the next run tries it again.
    WITH_FAILURES = "ended with failures"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"
    NOTHING_RUNS = "every unit was skipped"

    @property
    def is_done(self) -> bool:
        """Whether the run has computed everything that it could."""
        return self in (Ending.COMPLETE, Ending.WITH_FAILURES)


@dataclass(frozen=True)
class Request:
    """A request for points, estimates and scenes of ``pairs``, whose images are below ``root``.

    ``cameras`` are the user's known cameras. ``exports`` are the directories for COLMAP's
    files, by batch. ``publish`` is called with the state, whose
    ``fundamentals``, ``scenes`` and ``digests`` are the results so far: at the start, every half minute (less
    often if slow), after each scene with files, and at the end. A trial is not the run's result: its table of
    pairs is not stored.
    """

    pairs: Sequence[Pair]
    recipe: Recipe
    keys: Keys
    root: str = ""
    cameras: Rows = ()
    exports: Mapping[str, HeldDirectory] = field(default_factory=dict)
    about: About = field(default_factory=About)
    publish: "Callable[[State], None]" = lambda _: None
    is_trial: bool = False

    @property
    def uses_cameras(self) -> bool:
        """Whether a pair's estimate comes from its cameras where these exist, and not from MAGSAC.

        The cameras are the result of a run with files, and F of a pair is for its report alone. With one
        unit, MAGSAC takes a notable share of the time. Pairs of distorted cameras take F from MAGSAC.
        """
        return self.recipe.scene is not None and bool(self.exports) and len(self.recipe.units) == 1


@dataclass(frozen=True)
class RunReport:
    """The outcome of a run: tables with a row for each pair, in order, and how the run ended.

    ``resumed`` is the number of pairs that earlier runs finished. ``faults`` are lost jobs and unwritten files.
    ``unwritten`` says why the last version of the results could not be written.
    """

    tables: PairTables
    ending: Ending
    seconds: float
    resumed: int = 0
    faults: tuple[str, ...] = ()
    explanations: tuple[Event, ...] = ()  # decisions of the schedule
    unwritten: str = ""
    unsaved: str = ""  # why the journal does not have all results
    scenes: tuple[SceneRecord, ...] = ()
    units_run: int = 0
    units_failed: int = 0  # that raised
    estimated: int = 0
    log: Path | None = None  # the output of workers' libraries, if any
