"""The table of estimates: which pairs to estimate next, how long that takes, and the results."""

from collections.abc import Sequence
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import WINDOW
from mkpc_kaggle.engine.jobs import Estimated, EstimateJob, Failure
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.plan import HANG_FACTOR, Mask, Plan
from mkpc_kaggle.engine.request import Chronicle
from mkpc_kaggle.engine.state import State

MAX_PAIRS = 8  # in a job


class Estimates:
    """The rows whose estimate is missing or out of date. ``busy`` (N,) are the pairs of jobs under way."""

    def __init__(self, state: State, plan: Plan, order: Sequence[int], chronicle: Chronicle) -> None:
        self.busy = np.zeros(len(state.pairs), bool)
        self._state, self._plan, self._chronicle = state, plan, chronicle
        self._order = np.asarray(order, int)
        self._losses: Losses[int] = Losses()
        self._seconds: list[float] = []

    def due(self, now: float) -> NDArray[np.int_]:
        """Return the rows to estimate now, those without any F first. Others wait until they have what fits."""
        state = self._state
        due = state.has_row & state.had.any(1) & ~state.is_estimated & ~self.busy
        due &= self._plan.settled(now) | ~state.has_own
        due[list(self._losses.skipped)] = False
        order = self._order[due[self._order]]
        return np.asarray(order[np.argsort(state.has_own[order], kind="stable")])

    def pending(self, now: float) -> Mask:
        """(N,): the pairs that are due or busy."""
        pending = self.busy.copy()
        pending[self.due(now)] = True
        return pending

    def reserve(self, now: float, workers: int) -> float:
        """Return the seconds that the due estimates will probably take."""
        return fmean(self._seconds or [0.0]) * len(self.due(now)) / workers

    def has_work(self, now: float) -> bool:
        return bool(len(self.due(now)))

    def next(self, now: float) -> EstimateJob | None:
        due = self.due(now).tolist()
        is_retry = bool(due) and due[0] in self._losses.alone
        chosen = due[:1] if is_retry else [index for index in due if index not in self._losses.alone][:MAX_PAIRS]
        self.busy[chosen] = True
        pairs, source = self._state.points_of(chosen)
        return EstimateJob(pairs, self._state.request.recipe, source, is_retry) if pairs else None

    def patience(self, job: EstimateJob, unknown: float) -> float:
        return HANG_FACTOR * len(job.pairs) * fmean(self._seconds) if self._seconds else unknown

    def save(self, job: EstimateJob, answer: Sequence[Estimated], _: float) -> None:
        state, indices = self._state, [pair.index for pair in job.pairs]
        state.journal.save_estimates(answer)
        self._chronicle.estimated += len(answer)
        self.busy[indices] = False
        self._seconds = [*self._seconds, *(each.seconds for each in answer)][-WINDOW:]
        state.refresh(indices)
        if not self._plan.busy.any():
            rows = slice(state.rows)
            done, total = state.is_estimated[rows].sum(), state.had[rows].any(1).sum()
            self._chronicle.progress.show("estimate", int(done), int(total))

    def lose(self, job: EstimateJob, failure: Failure) -> None:
        """Try the pairs of a lost job again, one by one. A pair that is lost twice keeps the F that it has."""
        indices = [pair.index for pair in job.pairs]
        self.busy[indices] = False
        if self._losses.add(indices, failure):
            self._chronicle.explain(f"pair {indices[0]} keeps the F it has: {failure}")
