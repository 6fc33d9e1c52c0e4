"""The choice of the next units and pairs, by one priority order over the state of all pairs.

A plan has no queue. It looks at the state, the costs and the time left whenever a worker is idle.

Two rules decide that a unit no longer fits in time: :meth:`Plan.fit` for all pairs, and
:class:`mkpc_kaggle.engine.worker.MatchRunner` for the units of a job that ran out of time.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import Budget, Costs, format_duration
from mkpc_kaggle.engine.jobs import Cause, Failure, Losses, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.recipe import Unit

CONNECT_SHARE = 0.1  # of the time after the sweep, for extra pairs
JOB_SHARE = 0.01  # maximum share of the time left for a job of several units
HANG_FACTOR = 30.0  # a job that takes this multiple of its measured cost hangs
RESERVE_SHARE = 0.2  # maximum share of the limit that is reserved for estimates and scenes
MAX_FAILED_PAIRS = 2  # a unit that was skipped on this many pairs and never ran is skipped on all pairs

Mask = NDArray[np.bool_]


class Plan:
    """The priorities of a run: sweep, connect, deepen, fill.

    ``order`` visits pairs so that cached encodings are reused. ``workers`` is the number of parallel workers;
    ``is_closed`` means that no worker is left. ``reserve`` is the time at the end for estimates and scenes, in
    seconds. ``busy`` (N,) marks the pairs of running jobs, ``unusable`` (U,) the units that no worker can run.
    ``announce`` receives one line for the user, ``explain`` a line for each decision.
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
        """Forget everything about the devices: costs, losses, units that cannot run."""
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
        """The time after which no unit may run."""
        return self.budget.stop_units - min(self.reserve, RESERVE_SHARE * self.budget.time_limit)

    def next(self, now: float) -> MatchJob | None:
        """Return the next job for an idle worker, without its pairs; ``None`` if nothing can be done now."""
        wanted = self._wanted(now)
        best = np.where(self.busy, Phase.NEVER, wanted.min(1))
        if (phase := Phase(best.min(initial=Phase.NEVER))) is Phase.NEVER:
            return None
        self._enter(phase, now)
        return self._job(phase, wanted <= phase, best == phase, now)

    def has_work(self, now: float) -> bool:
        return not self.is_closed and bool((self._wanted(now)[~self.busy] < Phase.NEVER).any())

    def settled(self, now: float, phase: Phase = Phase.FILL) -> Mask:
        """Return an (N,) mask of the pairs that get no further unit before ``phase``; ``NEVER``: none at all."""
        return np.asarray((self._wanted(now).min(1) >= phase) & ~self.busy)

    def fit(self, now: float) -> int:
        """Return the length of the longest prefix of the recipe that all rows can have in the time left."""
        left = (self.stop - now) * self.workers
        return int(np.searchsorted(self._needed, left, side="right")) if left > 0 else 0

    def outlook(self, now: float) -> str:
        """Return how long all missing units would take, and how many units fit in the time left."""
        usable, unknown = int((~self.unusable).sum()), int(self._unmeasured.sum())
        text = f"all units on all pairs would take {format_duration(self._needed[-1] / self.workers)}"
        text += f", and {unknown} units were not measured yet" if unknown else ""
        if not isfinite(self.stop):
            return f"{text}; there is no time limit"
        left = format_duration(max(0.0, self.stop - now))
        return f"{text}; {min(self.fit(now), usable)} of {usable} units fit in the remaining {left}"

    def _look(self) -> None:
        """Update which units pairs can still get, and how many seconds each prefix of the recipe takes."""
        missing = ~self.state.had & ~self.unusable & ~self.state.unreadable[:, None]
        for index, name in self.losses.skipped:
            missing[index, self._numbers[name]] = False
        self._missing = missing
        self._means = np.array([self.costs.mean(unit.name) for unit in self.units])
        self._unmeasured = ~self.unusable & [not self.costs.is_known(unit.name) for unit in self.units]
        forecasts = [self.costs.forecast(unit.name) for unit in self.units]
        self._needed = np.cumsum(missing[: self.state.rows].sum(0) * forecasts)

    def _wanted(self, now: float) -> NDArray[np.int_]:
        """Return the phase (N, U) in which a pair gets a unit; ``NEVER`` if the unit would not end in time."""
        return np.where(self._means < self.stop - now, self._phases(now), Phase.NEVER)

    def _phases(self, now: float) -> NDArray[np.int_]:
        """Return the phase (N, U) of each pair's missing units; ``NEVER`` for the other units."""
        phases = np.full(self._missing.shape, Phase.NEVER)
        rows, extra = phases[: self.state.rows], phases[self.state.rows :]
        rows[:] = np.where(np.arange(len(self.units)) < self.fit(now), Phase.DEEPEN, Phase.FILL)
        rows[:, self._first] = Phase.SWEEP
        extra[self._connecting(now), self._first] = Phase.CONNECT
        return np.where(self._missing, phases, Phase.NEVER)

    @property
    def _first(self) -> int:
        """The number of the sweep's unit; -1 if no unit can run."""
        usable = (n for n, unit in enumerate(self.units) if unit.stage == 1 and not self.unusable[n])
        return next(usable, -1)

    def _connecting(self, now: float) -> Mask:
        """Return an (N - rows,) mask of the extra pairs that fit in a tenth of the time, the most useful first."""
        had = self.state.had[self.state.rows :, self._first]
        seconds = self.costs.forecast(self.units[self._first].name) / self.workers
        most = CONNECT_SHARE * (max(0.0, self.stop - now) + had.sum() * seconds)
        return np.asarray(np.arange(1, had.size + 1) * seconds <= most)

    def _job(self, phase: Phase, missing: Mask, ready: Mask, now: float) -> MatchJob:
        """Return a job for the first pair, or on a GPU for a minibatch of pairs with the same missing units."""
        order = self._order[ready[self._order]]
        if phase is Phase.FILL:
            order = order[np.argsort(self.state.inliers[order], kind="stable")]
        first = int(order[0])
        numbers = sorted(np.flatnonzero(missing[first]).tolist(), key=lambda number: self.units[number].stage)
        units = [self.units[number] for number in numbers]
        alone = any((first, unit.name) in self.losses.alone for unit in units)
        alike = order[(missing[order] == missing[first]).all(1)]
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

    def patience(self, job: MatchJob) -> float | None:
        """Return the seconds after which a job counts as hung, warm-up included; ``None`` if a cost is unknown."""
        if not all(self.costs.is_known(unit.name) for unit in job.units):
            return None
        expected = len(job.indices) * sum(self.costs.mean(unit.name) for unit in job.units)
        return HANG_FACTOR * expected + self.costs.warm_up(job.units)

    def _enter(self, phase: Phase, now: float) -> None:
        """Explain a change of the phase or of the units that fit. Announce the outlook once, by measured costs."""
        self.phase = phase
        if phase is Phase.SWEEP:
            return
        if (fitting := f"{phase} {self.fit(now) if phase is Phase.DEEPEN else ''}") != self._explained:
            self.explain(f"{phase}: {self.outlook(now)}")
            self._explained = fitting
        is_measured = phase is Phase.DEEPEN and not self._unmeasured.any()
        if not self._is_announced and (phase is Phase.FILL or is_measured):
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
        """Record a lost job; retry its pairs and units one by one. Skip a unit that is lost twice on a pair."""
        self.busy[list(job.indices)] = False
        lost = [(index, unit.name) for index in job.indices for unit in job.units]
        if failure.cause is Cause.DEVICE:  # counts against the worker's place, not the unit
            self.losses.alone.update(lost)
        elif self.losses.add(lost, failure):
            ((index, name),) = lost
            self.explain(f"{name} is skipped on pair {index} ({failure})")
            pairs = Counter(unit for _, unit in self.losses.skipped)[name]
            if pairs >= MAX_FAILED_PAIRS and not self.costs.mean(name):
                self.unusable[self._numbers[name]] = True
                self.explain(f"{name} is skipped on all pairs: it never ran ({failure})")
        self._look()

    @property
    def is_complete(self) -> bool:
        """Whether all rows have all units that can run."""
        return not self._missing[: self.state.rows].any()

    @property
    def nothing_runs(self) -> bool:
        return bool(self.unusable.all())

    def progress(self, now: float) -> tuple[str, int, int]:
        """Return the phase, the number of its finished pairs, and the number of all its pairs."""
        pairs, total = slice(self.state.rows), self.state.rows
        if self.phase is Phase.CONNECT:
            pairs, total = slice(total, None), int(self._connecting(now).sum())
        pending = self._phases(now)[pairs].min(1) <= self.phase
        return str(self.phase), total - int(pending.sum()), total
