"""Which pairs to estimate next, and how long that takes."""

from collections.abc import Sequence
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.costs import WINDOW
from mkpc_kaggle.engine.jobs import Estimated, EstimateJob, Failure
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.plan import HANG_FACTOR, Plan

MAX_PAIRS = 8  # in a job


class EstimatePlan:
    """The rows whose estimate is missing or out of date. ``busy`` (N,) are the pairs of jobs under way."""

    def __init__(self, plan: Plan, order: Sequence[int]) -> None:
        self.busy = np.zeros(len(plan.state.had), bool)
        self._plan, self._order = plan, np.asarray(order, int)
        self._losses: Losses[int] = Losses()
        self._seconds: list[float] = []

    def due(self, now: float) -> NDArray[np.int_]:
        """Return the rows to estimate now, those without any F first. Others wait until they have what fits."""
        state = self._plan.state
        due = state.has_row & state.had.any(1) & ~state.is_estimated & ~self.busy
        due &= self._plan.settled(now) | ~state.has_own
        due[list(self._losses.skipped)] = False
        order = self._order[due[self._order]]
        return np.asarray(order[np.argsort(state.has_own[order], kind="stable")])

    def next(self, now: float) -> tuple[list[int], bool]:
        """Return the pairs of the next job, and whether a worker was lost at them before."""
        due = self.due(now).tolist()
        is_retry = bool(due) and due[0] in self._losses.alone
        chosen = due[:1] if is_retry else [index for index in due if index not in self._losses.alone][:MAX_PAIRS]
        self.busy[chosen] = True
        return chosen, is_retry

    def reserve(self, now: float, workers: int) -> float:
        """Return the seconds that the due estimates will probably take."""
        return fmean(self._seconds or [0.0]) * len(self.due(now)) / workers

    def patience(self, job: EstimateJob) -> float:
        """Return the seconds after which a job hangs; infinity before any was measured."""
        return HANG_FACTOR * len(job.pairs) * fmean(self._seconds) if self._seconds else float("inf")

    def on_result(self, answer: Sequence[Estimated]) -> list[int]:
        """Record an answer. Return its pairs."""
        indices = [each.index for each in answer]
        self.busy[indices] = False
        self._seconds = [*self._seconds, *(each.seconds for each in answer)][-WINDOW:]
        return indices

    def on_failure(self, job: EstimateJob, failure: Failure) -> bool:
        """Record a lost job. Return whether its single pair keeps the F that it has."""
        indices = [pair.index for pair in job.pairs]
        self.busy[indices] = False
        return self._losses.add(indices, failure)
