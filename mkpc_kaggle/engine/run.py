"""The common part of all kinds of work: the run's state, store, costs, and events.

Each kind has a file, from its jobs to their results: :mod:`matching`, :mod:`estimates` (with the features of
images) and :mod:`scenes`.
"""

import sqlite3
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mkpc_kaggle.engine.console import Event, EventKind, Progress, append_event, logger
from mkpc_kaggle.engine.jobs import Failure, PairInputs
from mkpc_kaggle.engine.plan.budget import Budget, Costs
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.store.database import Source, Store
from mkpc_kaggle.engine.store.tables import UnitPoints
from mkpc_kaggle.errors import plural

# Faults of a run with different texts, and its decisions. The number of units that fit may change with
# each job, for hours.
MAX_FAULTS, MAX_PLANS = 1000, 10_000


class EventLog:
    """The events and counts of this program, for its final report."""

    def __init__(self, directory: Path, budget: Budget) -> None:
        self._directory = directory
        self._budget = budget
        self.faults: list[str] = []
        self.plans: list[Event] = []
        self.units_run = 0
        self.units_failed = 0  # that raised
        self.estimated = 0

    def note(self, kind: EventKind, text: str = "") -> Event:
        event = Event(self._budget.spent(), kind, text)
        append_event(self._directory, event)
        return event

    def explain(self, text: str) -> None:
        """Record a decision."""
        if len(self.plans) > MAX_PLANS:
            return
        if len(self.plans) == MAX_PLANS:
            text = "further decisions are not listed"
        self.plans.append(self.note(EventKind.PLAN, text))

    def fault(self, text: str) -> None:
        """Record a fault, once for each text: a broken disk would fill the store with them."""
        if len(self.faults) >= MAX_FAULTS:
            text = "further faults are not listed"
        if text not in self.faults:
            self.faults.append(text)
            self.note(EventKind.FAULT, text)

    def warning(self, text: str) -> None:
        """Record a fault, and print it at once."""
        self.fault(text)
        logger.warning(text)


@dataclass(frozen=True, eq=False)
class Run:
    """A request's state, and where its results, costs and messages go."""

    state: State
    store: Store
    costs: Costs
    budget: Budget
    log: EventLog
    progress: Progress

    def source(self, pairs: Sequence[PairInputs], *, held: bool = False) -> Source | None:
        """Return where a worker finds the points of these pairs, or the points if ``held``.

        Return ``None`` if the store has lost points, which are matched again.
        """
        keys = [key for pair in pairs for key in pair.points.values()]
        source = self.store.held(UnitPoints, keys) if held else self.store.source(UnitPoints, keys)
        if source.directory is None and self.forget_lost(set(keys) - source.held.keys()):
            return None
        return source

    def forget_lost_points(self, pairs: Sequence[PairInputs]) -> bool:
        """Forget the points of these pairs that the store has lost. Return whether there are any."""
        keys = {key for pair in pairs for key in pair.points.values()}
        try:
            data = self.store.data(UnitPoints, keys)
        except sqlite3.Error:  # a disk that fails: perhaps they can be read later
            return False
        return self.forget_lost(keys - data.keys())

    def forget_lost(self, keys: Set[str]) -> bool:
        """Forget these points, so that they are matched again. Return whether there are any."""
        if keys:
            self.state.forget_points(keys)
            results = plural(len(keys), "result")
            self.log.fault(f"the journal has lost {results}, which this run computes again")
        return bool(keys)


class JobHandler(Protocol):
    """The part of a kind of work that the loop calls for any job; each kind also makes its jobs."""

    def save(self, job: Any, answer: Any, seconds: float) -> None:
        """Save the answer to a job that took ``seconds``: first in the store, then in the state."""

    def lose(self, job: Any, failure: Failure) -> None:
        """Let a lost job be tried again, item by item. Give up an item that was lost twice."""
