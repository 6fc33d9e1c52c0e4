"""The time of a run: durations, four deadlines, the measured costs of units, and when a silent worker hangs.

:func:`time_limit` says how long a job may take, by the costs that are known now. A worker that has not answered by
then gets SIGKILL (a Ray actor is killed by Ray), and its job is lost. A worker in a thread of the user's process
cannot be killed: the run continues without its answer.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import inf, sqrt
from statistics import fmean, median_low
from threading import Event
from typing import Any

from mkpc_kaggle.engine.request import Job, MatchJob, SceneJob
from mkpc_kaggle.recipe import Unit

# The final report may take five times as long as writing the submission.
SUMMARY_FACTOR = 5
# The next write may take 1.5 times the median of the latest writes.
WRITE_MARGIN = 1.5
MAX_WRITE_SHARE = 0.05  # maximum share of the limit for the forecast of a write
# Silence of a worker; the share is of the limit.
MAX_SILENCE_S, MIN_SILENCE_S, SILENCE_SHARE = 60.0, 5.0, 0.02
# Number of the latest measurements in the mean: costs drift when a GPU heats up or a disk is shared.
WINDOW = 64
# Margin of a forecast from one measurement, sqrt(n) times smaller from n measurements.
MARGIN = 0.4
SCENE_START_S = 3.0  # start-up time of a scene's process
# Per match of a reconstruction: the initial forecast, and a lower bound for the limit of a hang.
SCENE_MATCH_S = 5e-4
# Factor on a forecast: the time of scenes depends on more than their matches.
SCENE_MARGIN = 1.5
COST_OF_ESTIMATES = "estimate"  # the name of the cost of an estimate
# A job that takes this multiple of its measured cost hangs. Stalls of twenty times the cost, as in the
# simulator, must not cost a worker.
HANG_FACTOR = 30.0
# A job of unknown cost that takes longer than this share of the time left hangs. A first job may be
# slow (a warm-up, a slow disk), but the rest of the run must be able to make up for it.
UNKNOWN_SHARE = 0.25
MAX_UNKNOWN_S = 3600.0  # without a limit, no share is finite
# Expected seconds of an estimate that was not measured yet: 50,000 iterations of MAGSAC take
# 0.2 s, and a busy machine is slower.
UNMEASURED_ESTIMATE_S = 1.0
START_S = 300.0  # for a worker to load its matchers, which is slow from a network disk


@dataclass
class Budget:
    """The time of a run since ``started``, in seconds of ``clock``, which never jumps.

    No unit begins after ``stop_units``, and the run stops waiting for workers at ``stop_waiting``.
    The watchdog writes the submission at ``final_write``, if the run has not. The process ends before ``limit``.
    """

    started: float
    time_limit: float = inf
    clock: Callable[[], float] = time.monotonic
    # Seconds of the latest writes; five, so that the median ignores two slow ones
    writes: deque[float] = field(default_factory=lambda: deque(maxlen=5))

    @property
    def writing(self) -> float:
        """Seconds allowed for the next write, by the median of the latest writes, which ignores a
        slow one.
        """
        median = median_low(self.writes) if self.writes else 0.0
        return min(WRITE_MARGIN * median, MAX_WRITE_SHARE * self.time_limit)

    @property
    def reserve(self) -> float:
        """Seconds at the end in which no unit begins."""
        # At least 1.5 s for the ends of processes, even in runs of a minute.
        return min(max(1.5, 0.005 * self.time_limit), 60.0)

    @property
    def silence(self) -> float:
        """Seconds beyond the expected time after which a silent worker counts as hung."""
        return min(MAX_SILENCE_S, max(MIN_SILENCE_S, SILENCE_SHARE * self.time_limit))

    # Backwards from the limit: half of the reserve for the last answers, a quarter for the report, a
    # quarter for the last version; the measured writes are added.

    @property
    def stop_units(self) -> float:
        return self.stop_waiting - self.reserve / 2

    @property
    def stop_waiting(self) -> float:
        return self.final_write - self.reserve / 4 - SUMMARY_FACTOR * self.writing

    @property
    def final_write(self) -> float:
        return self.limit - self.reserve / 4 - self.writing

    @property
    def limit(self) -> float:
        return self.started + self.time_limit

    def is_over(self, interrupt: Event) -> bool:
        return interrupt.is_set() or self.clock() >= self.stop_waiting

    def left(self) -> float:
        """Return the seconds until :attr:`stop_units`; never negative."""
        return max(0.0, self.stop_units - self.clock())


class Costs:
    """Seconds of a unit on a pair, by name, of the estimate of a pair, and of a scene.

    A worker's first run of a unit is a warm-up. Its time is used as mean until another run, never
    as forecast.
    """

    def __init__(self) -> None:
        self._measured: dict[str, deque[float]] = {}
        self._warm_up: dict[str, float] = {}
        self._means: dict[str, float] = {}
        # Of this run's scenes, without their starts
        self._scene_seconds = 0.0
        self._scene_matches = 0

    def observe(self, unit: str, seconds: float, *, warm_up: bool = False) -> None:
        if warm_up:
            self._warm_up[unit] = seconds
        else:
            self._measured.setdefault(unit, deque(maxlen=WINDOW)).append(seconds)
        self._means[unit] = fmean(self._measured.get(unit, [seconds]))

    def is_known(self, unit: str) -> bool:
        """Return whether a run after the warm-up was measured."""
        return unit in self._measured

    def mean(self, unit: str) -> float:
        """Return the expected seconds on a pair; 0 if nothing is known."""
        return self._means.get(unit, 0.0)

    def forecast(self, unit: str) -> float:
        """Return the mean plus a margin that shrinks with more measurements; 0 without
        measurements.
        """
        if not self.is_known(unit):
            return 0.0
        margin = MARGIN / sqrt(len(self._measured[unit]))
        return self.mean(unit) * (1 + margin)

    def observe_scene(self, matches: int, seconds: float) -> None:
        self._scene_seconds += max(0.0, seconds - SCENE_START_S)
        self._scene_matches += matches

    def scenes(self, matches: Any) -> Any:
        """Return the expected seconds of a scene by its number of matches, or of several by an array of these."""
        # The matches of all scenes together, because small ones are mostly start-up time.
        rate = SCENE_MATCH_S
        if self._scene_matches:
            rate = self._scene_seconds / self._scene_matches
        return SCENE_START_S + matches * SCENE_MARGIN * rate

    def warm_up(self, units: Iterable[Unit]) -> float:
        """Return the longest warm-up of these units, in seconds, by the latest of each unit."""
        return max((self._warm_up.get(unit.name, 0.0) for unit in units), default=0.0)


def start_limit(budget: Budget, since: float, *, loads_matchers: bool) -> float:
    """Return the seconds after ``since`` within which a worker must have started."""
    return (
        START_S
        if loads_matchers
        else min(START_S, max(budget.silence, unknown(budget, since)))
    )


def unknown(budget: Budget, since: float) -> float:
    """Return the seconds that work of unknown cost may take from ``since``."""
    return min(MAX_UNKNOWN_S, UNKNOWN_SHARE * max(0.0, budget.stop_units - since))


def time_limit(job: Job, costs: Costs, budget: Budget, since: float) -> float:
    """Return the seconds after ``since``, the beginning of a job, within which its worker must answer.

    It is :attr:`Budget.silence`, and:

    - Matching: 30 times the mean seconds of the job's units, for each pair, and their longest warm-up once. Until
      all are measured: a quarter of the time that is left, an hour at most.
    - Estimates: 30 times the mean; until it is known, 30 s a pair, and no more than that quarter.
    - A scene: 30 times the seconds expected from other scenes, at least of 3 s and 0.5 ms per match.
    """
    seconds = unknown(budget, since)
    if isinstance(job, MatchJob):
        # A warm-up alone says little: it may take a hundred times as long as a later run, or less.
        if all(costs.is_known(unit.name) for unit in job.units):
            of_pair = sum(costs.mean(unit.name) for unit in job.units)
            seconds = HANG_FACTOR * len(job.pairs) * of_pair + costs.warm_up(job.units)
    elif isinstance(job, SceneJob):
        # Small scenes measured so far say little about the time of a large one.
        unmeasured = SCENE_START_S + SCENE_MATCH_S * job.matches
        seconds = HANG_FACTOR * max(costs.scenes(job.matches), unmeasured)
    else:
        of_pair = costs.mean(COST_OF_ESTIMATES)
        # A hung first estimate must not use up a short limit.
        most = inf if of_pair else seconds
        seconds = min(most, HANG_FACTOR * len(job.pairs) * (of_pair or UNMEASURED_ESTIMATE_S))
    return budget.silence + seconds
