"""A run's request, its events while running, and its final report."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import About, Event, EventKind, PairRecord, SceneRecord
from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.recipe import Recipe


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"
    NOTHING_RUNS = "every unit was skipped"


@dataclass(frozen=True)
class Request:
    """A request for points, estimates and scenes of ``pairs``, whose images are below ``root``.

    ``exports`` are the directories for COLMAP's files, by batch. ``publish`` is called with the results: at the
    start, every half minute (less often if slow), after each scene with files, and at the end.
    """

    pairs: Sequence[Pair]
    recipe: Recipe
    settings: Settings
    root: str = ""
    exports: Mapping[str, Path] = field(default_factory=dict)
    about: About | None = None
    publish: "Callable[[Standing], None]" = lambda _: None


@dataclass(frozen=True, eq=False)
class Standing:
    """The best results so far: F of the pairs (R, 3, 3), scenes by batch, and digests of images by name."""

    fundamentals: NDArray[np.float64]
    scenes: Mapping[str, SceneRecord]
    digests: Mapping[str, str]


class Chronicle:
    """Faults and decisions of a session, also saved as events in the journal, and counts of its results."""

    def __init__(self, journal: Journal, budget: Budget, progress: Progress) -> None:
        self.progress = progress
        self.faults: list[str] = []
        self.explanations: list[Event] = []
        self.units_run = self.estimated = 0
        self._journal, self._budget = journal, budget

    def note(self, kind: EventKind, text: str) -> Event:
        event = Event(kind, self._budget.spent(), text)
        self._journal.note(event)
        return event

    def explain(self, text: str) -> None:
        self.explanations.append(self.note(EventKind.PLAN, text))

    def fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)
            self.note(EventKind.FAULT, text)


@dataclass(frozen=True)
class RunReport:
    """The outcome of a run: a record of each pair, in order, and how the run ended.

    ``resumed`` is the number of pairs that earlier runs finished. ``faults`` are lost jobs and unwritten files.
    ``unwritten`` says why the last version of the results could not be written.
    """

    records: tuple[PairRecord, ...]
    ending: Ending
    seconds: float
    resumed: int = 0
    faults: tuple[str, ...] = ()
    explanations: tuple[Event, ...] = ()  # decisions of the plan
    unwritten: str = ""
    scenes: tuple[SceneRecord, ...] = ()
    units_run: int = 0
    estimated: int = 0
