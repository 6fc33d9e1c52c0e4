"""The table of points: the jobs that match pairs, and their results."""

from collections.abc import Sequence
from dataclasses import replace

from mkpc_kaggle.engine.jobs import Failure, MatchJob, Outcome
from mkpc_kaggle.engine.journal_reader import EventKind
from mkpc_kaggle.engine.plan import Plan
from mkpc_kaggle.engine.request import Chronicle
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.pipeline.pair import UnitResult


class Matching:
    """Points of units on pairs, in the order of the plan."""

    def __init__(self, state: State, plan: Plan, chronicle: Chronicle) -> None:
        self._state, self._plan, self._chronicle = state, plan, chronicle
        self._settings = dict(zip(state.units, state.request.settings.units, strict=True))

    def has_work(self, now: float) -> bool:
        return self._plan.has_work(now)

    def next(self, now: float) -> MatchJob | None:
        if (job := self._plan.next(now)) is None:
            return None
        needs_regions = any(unit.stage == 2 for unit in job.units)
        known = tuple(self._first_stage(index) if needs_regions else () for index in job.indices)
        upcoming = (path for index in self._plan.upcoming(job) for path in self._state.pairs[index].pair.images)
        pairs = tuple(self._state.pairs[index] for index in job.indices)
        return replace(job, pairs=pairs, known=known, upcoming=tuple(upcoming))

    def patience(self, job: MatchJob, unknown: float) -> float:
        return self._plan.patience(job, unknown)

    def save(self, job: MatchJob, answer: Sequence[Outcome], _: float) -> None:
        self._state.journal.save_outcomes(answer, self._settings)
        self._chronicle.units_run += sum(len(outcome.found) for outcome in answer)
        for outcome in answer:
            self._state.digests |= {image.name: image.digest for image in outcome.images}
        self._state.refresh(outcome.index for outcome in answer)
        self._plan.on_result(job, answer)
        seconds = sum(found.seconds for outcome in answer for found in outcome.found)
        self._chronicle.note(EventKind.JOB, f"{job.phase} {len(job.indices)} pairs {seconds:.3f} s")
        self._chronicle.progress.show(*self._plan.progress(self._plan.budget.clock()))

    def lose(self, job: MatchJob, failure: Failure) -> None:
        self._plan.on_failure(job, failure)

    def _first_stage(self, index: int) -> tuple[UnitResult, ...]:
        """Return the current points of stage 1, from which a pair's critical regions are computed."""
        journal, units = self._state.journal, self._state.units
        rows = {units[name]: row for name, row in journal.inputs(index).items() if units[name].stage == 1}
        points = journal.points(rows.values())
        return tuple(UnitResult(unit, points[row]) for unit, row in rows.items())
