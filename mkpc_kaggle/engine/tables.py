"""The derived tables of the journal: points, estimates, features. A table makes the jobs for its missing rows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import Costs
from mkpc_kaggle.engine.jobs import Estimated, EstimateJob, Failure, Job, LookJob, Losses, MatchJob, Outcome
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.plan import HANG_FACTOR, Mask, Plan
from mkpc_kaggle.engine.request import Chronicle
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.pipeline.pair import UnitResult

MAX_PAIRS = 8  # in a job of estimates

Key = tuple[str, str]  # of features: digest of the contents, digest of the settings


class Table(Protocol):
    def has_work(self, now: float) -> bool: ...

    def next(self, now: float) -> Job | None:
        """Return a job for an idle worker, or ``None``."""

    def patience(self, job: Any) -> float | None:
        """Return the seconds after which a job counts as hung, by measured costs; ``None`` if no cost is known."""

    def save(self, job: Any, answer: Any, seconds: float) -> None:
        """Save the answer to a job that took ``seconds``. Raise ``sqlite3.Error`` if no row can hold it."""

    def lose(self, job: Any, failure: Failure) -> None:
        """Record that a job failed, or that its worker was lost."""


class Points:
    """Points of units on pairs, in the order of the plan."""

    def __init__(self, state: State, plan: Plan, chronicle: Chronicle) -> None:
        self._state, self._plan, self._chronicle = state, plan, chronicle
        self.has_work, self.patience, self.lose = plan.has_work, plan.patience, plan.on_failure

    def next(self, now: float) -> MatchJob | None:
        if (job := self._plan.next(now)) is None:
            return None
        needs_regions = any(unit.stage == 2 for unit in job.units)
        known = tuple(self._first_stage(index) if needs_regions else () for index in job.indices)
        pairs = tuple(self._state.pairs[index] for index in job.indices)
        upcoming = (path for index in self._plan.upcoming(job) for path in self._state.pairs[index].pair.images)
        return replace(job, pairs=pairs, known=known, upcoming=tuple(upcoming))

    def save(self, job: MatchJob, answer: Sequence[Outcome], _: float) -> None:
        self._state.save_outcomes(answer)
        self._plan.on_result(job, answer)
        self._chronicle.units_run += sum(len(outcome.found) for outcome in answer)
        self._chronicle.progress.show(*self._plan.progress(self._plan.budget.clock()))

    def _first_stage(self, index: int) -> tuple[UnitResult, ...]:
        """Return the current points of stage 1, from which a pair's critical regions are computed."""
        journal, units = self._state.journal, self._state.units
        rows = {units[name]: row for name, row in journal.inputs(index).items() if units[name].stage == 1}
        points = journal.points(rows.values())
        return tuple(UnitResult(unit, points[row]) for unit, row in rows.items())


class Estimates:
    """The missing and outdated estimates of rows. ``busy`` (N,) marks the pairs of running jobs."""

    def __init__(self, state: State, plan: Plan, order: Sequence[int], chronicle: Chronicle) -> None:
        self.busy = np.zeros(len(state.pairs), bool)
        self._state, self._plan, self._chronicle = state, plan, chronicle
        self._order = np.asarray(order, int)
        self._losses: Losses[int] = Losses()
        self._costs = Costs()

    def due(self, now: float) -> NDArray[np.int_]:
        """Return the rows to estimate now: first rows without an F, then rows with all units that fit in time."""
        state = self._state
        due = state.had.any(1) & ~state.is_estimated & ~self.busy & (self._plan.settled(now) | ~state.has_own)
        due[state.rows :] = False
        due[list(self._losses.skipped)] = False
        order = self._order[due[self._order]]
        return np.asarray(order[np.argsort(state.has_own[order], kind="stable")])

    def pending(self, now: float) -> Mask:
        """Return an (N,) mask of the pairs that are due or busy."""
        pending = self.busy.copy()
        pending[self.due(now)] = True
        return pending

    def reserve(self, now: float, workers: int) -> float:
        """Return the seconds that the due estimates will probably take."""
        return self._costs.mean("estimate") * len(self.due(now)) / workers

    def has_work(self, now: float) -> bool:
        return bool(len(self.due(now)))

    def next(self, now: float) -> EstimateJob | None:
        due = self.due(now).tolist()
        is_retry = bool(due) and due[0] in self._losses.alone
        chosen = due[:1] if is_retry else [index for index in due if index not in self._losses.alone][:MAX_PAIRS]
        self.busy[chosen] = True
        pairs, source = self._state.points_of(chosen)
        return EstimateJob(pairs, self._state.request.recipe, source, is_retry) if pairs else None

    def patience(self, job: EstimateJob) -> float | None:
        return HANG_FACTOR * len(job.pairs) * self._costs.mean("estimate") or None

    def save(self, job: EstimateJob, answer: Sequence[Estimated], _: float) -> None:
        state, indices = self._state, [pair.index for pair in job.pairs]
        state.journal.save_estimates(answer)
        state.refresh(indices)
        self.busy[indices] = False
        for each in answer:
            self._costs.observe("estimate", each.seconds)
        self._chronicle.estimated += len(answer)
        if not self._plan.busy.any():
            rows = slice(state.rows)
            done, total = state.is_estimated[rows].sum(), state.had[rows].any(1).sum()
            self._chronicle.progress.show("estimate", int(done), int(total))

    def lose(self, job: EstimateJob, failure: Failure) -> None:
        """Retry the pairs of a lost job one by one. A pair that is lost twice keeps its present F."""
        indices = [pair.index for pair in job.pairs]
        self.busy[indices] = False
        if self._losses.add(indices, failure):
            self._chronicle.explain(f"pair {indices[0]} keeps the F it has: {failure}")


class Features:
    """Requested features of images and datasets. ``found`` has the features so far, by key."""

    def __init__(self, journal: Journal, looks: Mapping[Key, Callable[[], bytes]]) -> None:
        known = {key: journal.feature(*key) for key in looks}
        self.found = {key: value for key, value in known.items() if value is not None}
        self._journal, self._losses = journal, Losses[Key]()
        self._pending = {key: LookJob(key, do) for key, do in looks.items() if key not in self.found}

    def has_work(self, _: float) -> bool:
        return bool(self._pending)

    def next(self, _: float) -> LookJob | None:
        return self._pending.pop(next(iter(self._pending))) if self._pending else None

    def patience(self, _: LookJob) -> None:
        return None

    def save(self, job: LookJob, answer: bytes, _: float) -> None:
        self.found[job.key] = answer
        self._journal.save_feature(*job.key, answer)

    def lose(self, job: LookJob, failure: Failure) -> None:
        if not self._losses.add([job.key], failure):
            self._pending[job.key] = job
