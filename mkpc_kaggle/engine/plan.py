"""Which units to run on which pairs next: one priority order over the state of all pairs.

A plan has no queue. It looks at the state, the costs and the time left whenever a worker is idle.

Two places decide that a unit no longer fits: :meth:`Plan.fit` for all pairs, and
:meth:`mkpc_kaggle.engine.worker.MatchRunner.run` for a job whose time is over.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import Budget, Costs, format_duration
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.recipe import Unit

CONNECT_SHARE = 0.1  # of the time after the sweep, for extra pairs
JOB_SHARE = 0.01  # of the time left, which a job of several units takes at most
HANG_FACTOR = 30.0  # a job that takes this many times what was measured hangs
RESERVE_SHARE = 0.2  # of the limit, at most, that is reserved for scenes
MAX_FAILED_PAIRS = 2  # a unit that was skipped on this many pairs and never ran is skipped on all pairs

PHASES = tuple(Phase)
SWEEP, CONNECT, DEEPEN, FILL, NEVER = range(5)

Mask = NDArray[np.bool_]


class Plan:
    """The priorities of a run: sweep, connect, deepen, fill.

    ``order`` is the order in which encodings are cached best. ``workers`` match at the same time; ``is_closed``:
    none can any more. ``reserve`` seconds at the end belong to estimates and scenes. ``busy`` (N,) are the pairs
    of jobs under way, ``unusable`` (U,) the units that no worker can run. ``announce`` gets one line for the user,
    ``explain`` each decision.
    """

    def __init__(
        self,
        units: Sequence[Unit],
        state: State,
        order: Sequence[int],
        budget: Budget,
        explain: Callable[[str], None],
        announce: Callable[[str], None],
        minibatch: int = 1,
    ) -> None:
        self.units, self.state, self.budget = tuple(units), state, budget
        self.explain, self.announce = explain, announce
        self.workers, self.reserve, self.minibatch = 1, 0.0, minibatch
        self.busy = np.zeros(len(state.had), bool)
        self._order = np.asarray(order, int)
        self._numbers = {unit.name: number for number, unit in enumerate(self.units)}
        self.restart()

    def restart(self) -> None:
        """Forget all that was learnt of the devices: costs, losses, units that cannot run."""
        self.costs = Costs()
        self.losses: Losses[tuple[int, str]] = Losses()
        self.unusable = np.zeros(len(self.units), bool)
        self.phase = Phase.SWEEP
        self.is_closed = False
        self.busy[:] = False
        self._explained, self._is_announced = "", False
        self._look()

    @property
    def stop(self) -> float:
        """When no unit may run any more."""
        return self.budget.stop_units - min(self.reserve, RESERVE_SHARE * self.budget.time_limit)

    def next(self, now: float) -> MatchJob | None:
        """Return the next job for an idle worker, without its pairs; ``None`` if nothing can be done now."""
        wanted = self._wanted(now)
        best = np.where(self.busy, NEVER, wanted.min(1))
        number = int(best.min(initial=NEVER))
        if number == NEVER:
            return None
        self._enter(PHASES[number], now)
        return self._job(PHASES[number], wanted <= number, best == number, now)

    def has_work(self, now: float) -> bool:
        return not self.is_closed and bool((self._wanted(now)[~self.busy] < NEVER).any())

    def settled(self, now: float) -> Mask:
        """(N,): the pairs that get no further unit before the filling."""
        return np.asarray((self._wanted(now).min(1) >= FILL) & ~self.busy)

    def filled(self, now: float) -> Mask:
        """(N,): the pairs that get no further unit."""
        return np.asarray((self._wanted(now).min(1) == NEVER) & ~self.busy)

    def fit(self, now: float) -> int:
        """Return the length of the longest prefix of the recipe that all rows can have in the time left."""
        left = (self.stop - now) * self.workers
        return int(np.searchsorted(self._needed, left, side="right")) if left > 0 else 0

    def outlook(self, now: float) -> str:
        """Return how long all missing units would take, and how many units fit in the time left."""
        unknown = sum(not self.costs.is_known(unit.name) for unit in self._usable)
        text = f"all units on all pairs would take {format_duration(self._needed[-1] / self.workers)}"
        text += f", and {unknown} units were not measured yet" if unknown else ""
        if not isfinite(self.stop):
            return f"{text}; there is no time limit"
        usable, left = len(self._usable), max(0.0, self.stop - now)
        return (
            f"{text}; {min(self.fit(now), usable)} of {usable} units fit in the remaining {format_duration(left)}"
        )

    @property
    def _usable(self) -> list[Unit]:
        return [unit for unit, unusable in zip(self.units, self.unusable, strict=True) if not unusable]

    def _look(self) -> None:
        """Derive which units pairs can still get, and the seconds that prefixes of the recipe take."""
        missing = ~self.state.had & ~self.unusable & ~self.state.unreadable[:, None]
        for index, name in self.losses.skipped:
            missing[index, self._numbers[name]] = False
        self._missing = missing
        counts = missing[: self.state.rows].sum(0)
        forecasts = np.array([self.costs.forecast(unit.name) for unit in self.units])
        self._needed = np.cumsum(counts * forecasts)
        self._means = np.array([self.costs.mean(unit.name) for unit in self.units])

    def _wanted(self, now: float) -> NDArray[np.int_]:
        """(N, U): the number of the phase in which a pair gets a unit; ``NEVER`` if it would not end in time."""
        return np.where(self._means < self.stop - now, self._phases(now), NEVER)

    def _phases(self, now: float) -> NDArray[np.int_]:
        """(N, U): the number of the phase to which a missing unit belongs; ``NEVER`` elsewhere."""
        phases = np.full(self._missing.shape, NEVER)
        rows, extra = phases[: self.state.rows], phases[self.state.rows :]
        rows[:] = np.where(np.arange(len(self.units)) < self.fit(now), DEEPEN, FILL)
        rows[:, self._first] = SWEEP
        extra[self._connecting(now), self._first] = CONNECT
        return np.where(self._missing, phases, NEVER)

    @property
    def _first(self) -> int:
        """The unit of the sweep; -1 if none can run."""
        usable = (n for n, unit in enumerate(self.units) if unit.stage == 1 and not self.unusable[n])
        return next(usable, -1)

    def _connecting(self, now: float) -> Mask:
        """(N - rows,): the extra pairs that a tenth of the time suffices for, the most useful first."""
        had = self.state.had[self.state.rows :, self._first]
        seconds = self.costs.forecast(self.units[self._first].name) / self.workers
        most = CONNECT_SHARE * (max(0.0, self.stop - now) + had.sum() * seconds)
        return np.asarray(np.arange(1, had.size + 1) * seconds <= most)

    def _job(self, phase: Phase, lacking: Mask, ready: Mask, now: float) -> MatchJob:
        """A job for the first pair, or on a GPU for a minibatch of pairs with the same missing units."""
        order = self._order[ready[self._order]]
        if phase is Phase.FILL:
            order = order[np.argsort(self.state.inliers[order], kind="stable")]
        first = int(order[0])
        numbers = sorted(np.flatnonzero(lacking[first]).tolist(), key=lambda number: self.units[number].stage)
        units = [self.units[number] for number in numbers]
        alone = any((first, unit.name) in self.losses.alone for unit in units)
        alike = order[(lacking[order] == lacking[first]).all(1)]
        indices = tuple(alike[: 1 if alone else self.minibatch].tolist())
        seconds = [self.costs.mean(unit.name) if self.costs.is_known(unit.name) else inf for unit in units]
        fits = np.cumsum(seconds) * len(indices) < JOB_SHARE * (self.stop - now)
        units = units[: 1 if alone else max(1, fits.sum())]
        self.busy[list(indices)] = True
        expected = tuple(self.costs.mean(unit.name) for unit in units)
        return MatchJob(phase, indices, tuple(units), expected, self.stop - now, is_retry=alone)

    def upcoming(self, job: MatchJob) -> list[int]:
        """Return the pairs that will probably be matched after a job."""
        rank = int(np.flatnonzero(self._order == job.indices[-1])[0]) + 1
        return self._order[rank : rank + self.minibatch].tolist() if job.phase is not Phase.FILL else []

    def patience(self, job: MatchJob, unknown: float) -> float:
        """Return the seconds after which a job hangs, perhaps on a new worker; ``unknown`` if a cost is."""
        if not all(self.costs.is_known(unit.name) for unit in job.units):
            return unknown
        expected = len(job.indices) * sum(self.costs.mean(unit.name) for unit in job.units)
        return HANG_FACTOR * expected + self.costs.warm_up(job.units)

    def _enter(self, phase: Phase, now: float) -> None:
        """Explain a change of the phase or of the units that fit. Announce once how many fit by measured costs."""
        self.phase = phase
        if phase is Phase.SWEEP:
            return
        fitting = f"{phase} {self.fit(now) if phase is Phase.DEEPEN else ''}"
        if fitting != self._explained:
            self.explain(f"{phase}: {self.outlook(now)}")
            self._explained = fitting
        is_measured = all(self.costs.is_known(unit.name) for unit in self._usable)
        if not self._is_announced and (phase is Phase.FILL or (phase is Phase.DEEPEN and is_measured)):
            self.announce(self.outlook(now))
            self._is_announced = True

    # Results

    def on_result(self, job: MatchJob, outcomes: Sequence[Outcome]) -> None:
        self.busy[list(job.indices)] = False
        for outcome in outcomes:
            self.state.unreadable[outcome.index] |= bool(outcome.failure)
            for found in outcome.found:
                self.costs.observe(found.unit.name, found.seconds, warm_up=found.warm_up)
        self._look()

    def on_failure(self, job: MatchJob, failure: Failure) -> None:
        """Record a lost job: it comes back as single pairs and units. Skip a unit that is lost twice on a pair."""
        self.busy[list(job.indices)] = False
        lost = [(index, unit.name) for index in job.indices for unit in job.units]
        if failure.cause is Cause.DEVICE:  # it counts against the place
            self.losses.alone.update(lost)
        elif self.losses.add(lost, failure):
            self._skip(*lost[0], failure)
        self._look()

    def _skip(self, index: int, name: str, failure: Failure) -> None:
        self.explain(f"{name} is skipped on pair {index} ({failure})")
        pairs = Counter(unit for _, unit in self.losses.skipped)[name]
        if pairs >= MAX_FAILED_PAIRS and not self.costs.has_run(name):
            self.unusable[self._numbers[name]] = True
            self.explain(f"{name} is skipped on all pairs: it never ran ({failure})")

    # The remaining work

    @property
    def is_complete(self) -> bool:
        """Whether all rows have all units that can run."""
        return not self._missing[: self.state.rows].any()

    @property
    def nothing_runs(self) -> bool:
        return bool(self.unusable.all())

    def progress(self, now: float) -> tuple[Phase, int, int]:
        """Return the phase, the number of its pairs that are done, and the number of its pairs."""
        pending = self._phases(now).min(1) <= PHASES.index(self.phase)
        rows, total = pending[: self.state.rows], self.state.rows
        if self.phase is Phase.CONNECT:
            rows, total = pending[self.state.rows :], int(self._connecting(now).sum())
        return self.phase, total - int(rows.sum()), total
