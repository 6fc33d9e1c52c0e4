"""What to do next: a pure function of the state of all pairs, the costs and the time.

A :class:`Plan` has no queue and no memory. The first unit runs on all pairs (sweep), then on extra pairs
(connect), then the units that fit for all pairs (deepen), then the others, weakest pairs first (fill).

A unit no longer fits in time by two rules. The time left ends at ``stop_units`` (the limit less 0.5 % of it, 1.5
to 60 s, and six forecasts of a write), less up to a fifth of the limit for the estimates, scenes and candidates
that are still due.

- The prefix that fits: a unit whose forecast, with those of the units before it, for all missing pairs exceeds the
  time left of all workers waits for the last phase, unless it is the unit of the sweep. A unit of stage 2 counts
  for the share of pairs that need it.
- By its mean, one more pair would not end in time: the unit does not begin, in any phase, nor does a crop that
  depends on it. Near the end, a minibatch is made smaller first.

A forecast is the mean of the latest runs and a margin, 40 % after one and 5 % after many. It is 0 for a unit that
has had no run but its warm-up; the mean is that of the warm-up then. A worker applies the second rule again before
each minibatch, by its own clock (:class:`mkpc_kaggle.engine.worker.MatchRunner`).
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import COST_OF_ESTIMATES, Budget, Costs
from mkpc_kaggle.engine.request import MatchPlan
from mkpc_kaggle.engine.state import (
    CONNECT,
    DEEPEN,
    ESTIMATE,
    FILL,
    GIVEN_UP,
    NEVER,
    SWEEP,
    Mask,
    State,
)

# Maximum share of the time after the sweep for extra pairs: they only serve scenes.
CONNECT_SHARE = 0.1
# Maximum share of the time left for a job of several units. A longer job would delay scenes that wait
# for its pair, and a lost job repeats all of its units.
JOB_SHARE = 0.01
# Maximum share of the limit that is reserved for estimates and scenes: a wrong forecast must not stop
# the matching, on which every row depends.
RESERVE_SHARE = 0.2
# Maximum share of the limit that is reserved for further candidates of scenes: any scene is worth
# more than a choice of scenes.
CANDIDATES_SHARE = 0.05
# Estimates that are handed out at a time. A list of all due estimates, made again for each job, would cost the
# loop more than the jobs in a run of 500,000 pairs.
MAX_DUE = 1000
NEIGHBOURS = 100  # minibatches in which pairs with the same missing units are searched


@dataclass(frozen=True)
class Crew:
    """The workers of a run: how many match, estimate and reconstruct at a time; 0 if none is left.

    ``minibatch`` is the number of pairs in a job of matching. Next to matching, only ``beside`` scenes are made.
    """

    matchers: int = 1
    estimators: int = 1
    scenes: int = 1
    minibatch: int = 1
    beside: int = 1


@dataclass(frozen=True)
class Plan:
    """What to do at the time ``now``: a job of matching, estimates and scenes, each computed when it is asked for.

    ``lost`` counts the jobs that the asking place lost since its last answer.
    """

    state: State
    costs: Costs
    budget: Budget
    crew: Crew
    now: float
    lost: int = 0

    @cached_property
    def left(self) -> float:
        """The seconds until no unit may run, so that estimates, scenes and candidates have theirs."""
        crew = self.crew
        waiting = np.count_nonzero(self.lacks_estimate)
        seconds = self.costs.mean(COST_OF_ESTIMATES) * waiting / max(1, crew.estimators)
        if crew.scenes:
            first = self.scene_seconds[:, 0]
            seconds += max(first.max(initial=0.0), first.sum() / crew.scenes)
            others = float(self.scene_seconds[:, 1:].sum()) / crew.scenes
            seconds += min(CANDIDATES_SHARE * self.budget.time_limit, others)
        reserve = min(seconds, RESERVE_SHARE * self.budget.time_limit)
        return max(0.0, self.budget.stop_units - reserve - self.now)

    @cached_property
    def lacks_estimate(self) -> Mask:
        return self.state.lacks_estimate

    @cached_property
    def scene_seconds(self) -> NDArray[np.float64]:
        """The expected seconds (B, C) of the scenes that are missing and have matches; 0 for others."""
        matches = self.state.scene_matches
        is_open = self.state.missing_scenes & (matches > 0)
        return np.asarray(self.costs.scenes(matches) * is_open)

    # Matching

    @cached_property
    def missing(self) -> Mask:
        return self.state.missing

    @cached_property
    def fit(self) -> int:
        """The length of the longest prefix of the recipe that all rows can have in the time left."""
        if not self.left:  # an unmeasured unit needs no time, but fits no more
            return 0
        state = self.state
        forecasts = np.array([self.costs.forecast(unit.name) for unit in state.units])
        # The share of the known pairs that need a unit, and one more that needs it. Extra pairs are left out: they
        # have a share of the time, not a claim.
        used, done, missing = (
            np.array([np.count_nonzero(unit[: state.rows]) for unit in cells.T])
            for cells in (state.used, state.done, self.missing)
        )
        seconds = np.cumsum(missing * forecasts * (used + 1) / (done + 1))
        most = self.left * max(1, self.crew.matchers)
        return int(np.searchsorted(seconds, most, side="right"))

    @cached_property
    def extra(self) -> int:
        """The number of extra pairs that fit in a tenth of the time, the most useful first."""
        state = self.state
        seconds = self.costs.forecast(state.units[state.sweep].name) / max(
            1, self.crew.matchers
        )
        # A share of the time after the sweep, as it was before the first extra pair
        had = np.count_nonzero(state.done[state.rows :, state.sweep])
        most = CONNECT_SHARE * (self.left / max(seconds, 1e-9) + had)
        return int(min(most, len(state.pairs)))

    @cached_property
    def wanted(self) -> NDArray[np.int8]:
        """The phase (N, U) of each pair's missing units; ``NEVER`` for other units, for those that would not end
        in time, and for crops that depend on them.
        """
        state = self.state
        phases = np.full_like(self.missing, FILL, np.int8)
        phases[:, : self.fit] = DEEPEN
        phases[:, state.sweep] = SWEEP
        phases[state.rows :] = NEVER
        phases[state.rows : state.rows + self.extra, state.sweep] = CONNECT
        # A pair that cost two workers may cost two more for each unit, so all others come first.
        costly = (state.losses[:, :-1] == GIVEN_UP).any(1)
        phases[costly] = np.maximum(phases[costly], FILL)
        phases = np.maximum(phases, np.int8(NEVER) * ~self.missing)
        # Pairs of which an earlier unit of stage 1 is missing, and has no time
        never = np.zeros_like(costly)
        for unit, crop in enumerate(state.is_crop.tolist()):
            mean = self.costs.mean(state.units[unit].name)
            if not self.crew.matchers or mean >= self.left:
                phases[:, unit] = NEVER
            elif crop:
                phases[never, unit] = NEVER
            if not crop:
                never |= self.missing[:, unit] & (phases[:, unit] == NEVER)
        return phases

    @cached_property
    def first(self) -> NDArray[np.int8]:
        """The phase (N,) of each pair's next unit."""
        return np.asarray(self.wanted.min(1))

    @cached_property
    def phase(self) -> int:
        """The most urgent phase that has a pair without a job."""
        return int(self.first[self.state.busy == NEVER].min(initial=NEVER))

    @cached_property
    def match(self) -> MatchPlan | None:
        """A job for the first pair in order, or on a GPU for a minibatch of pairs with the same wanted units.

        A job takes the units of its phase and of earlier phases, which other pairs have finished. A suspect, which
        had a lost job, and a place that lost its latest job get one unit on one pair, so that another loss has one
        cause.
        """
        if self.phase == NEVER:
            return None
        state = self.state
        costs = self.costs
        order = self._order()
        pair = order[0]
        wanted = self.wanted <= self.phase
        units = np.flatnonzero(wanted[pair]).tolist()
        names = [state.units[unit].name for unit in units]
        seconds = list(map(costs.mean, names))
        if self.lost or state.is_suspect[pair]:
            units = units[:1]
            # No image is decoded ahead, which could be another cause.
            order = pairs = order[:1]
        else:
            # Near the end, a smaller minibatch still ends in time.
            size = max(1, int(min(self.crew.minibatch, self.left / max(seconds[0], 1e-9))))
            near = order[: NEIGHBOURS * size]
            alike = (wanted[near] == wanted[pair]).all(1) & ~state.is_suspect[near]
            pairs = near[alike][:size]
            # An unmeasured unit counts as infinitely long, so its cost is learnt from a job of one unit.
            known = [costs.mean(name) if costs.is_known(name) else inf for name in names]
            count = int((np.cumsum(known) * len(pairs) < JOB_SHARE * self.left).sum())
            units = units[: max(1, count)]
        # In the last phase, the order depends on inliers that come meanwhile.
        upcoming = (
            order[len(pairs) :][: self.crew.minibatch] if self.phase < FILL else order[:0]
        )
        return MatchPlan(
            self.phase,
            pairs.tolist(),
            units,
            seconds[: len(units)],
            self.left,
            upcoming.tolist(),
        )

    def _order(self) -> NDArray[np.int_]:
        """Return the pairs of the phase in their order: visiting order, for the cache of encodings, and in the
        last phase the weakest first. Suspects come last.

        A place that has lost jobs continues a third of the order further, because neighbours share an image.
        """
        state = self.state
        is_ready = (self.first == self.phase) & (state.busy == NEVER)
        order = state.order[is_ready[state.order]]
        if self.phase == FILL:
            order = order[np.argsort(state.inliers[order], kind="stable")]
        suspect = state.is_suspect[order]
        fresh = order[~suspect]
        third = len(fresh) * min(self.lost, 2) // 3
        return np.concatenate([fresh[third:], fresh[:third], order[suspect]])

    # Estimates and scenes

    @cached_property
    def estimates(self) -> list[int]:
        """The first rows to estimate now: rows without any F, then rows with all units that fit in time; those
        with a lost job last.
        """
        state = self.state
        order = state.order[self._due[state.order]]
        rank = state.has_f[order] + 2 * (state.losses[order, ESTIMATE] > 0)
        return list(order[np.argsort(rank, kind="stable")][:MAX_DUE].tolist())

    @cached_property
    def _due(self) -> Mask:
        # A settled pair gets no other unit soon. A pair without an F is estimated at once: any F is better
        # than the fallback.
        state = self.state
        settled = (self.first >= FILL) & (state.busy == NEVER)
        due = self.lacks_estimate & ~state.estimating & (settled | ~state.has_f)
        return np.asarray(due & bool(self.crew.estimators))

    @cached_property
    def scenes(self) -> list[tuple[int, int]]:
        """The scenes to make now, as (batch, candidate); batches without any scene come first.

        A first scene waits for units that fit in time and for estimates, a later scene for all units. Further
        candidates wait for the end of matching, and must be expected to end in time.
        """
        state = self.state
        busy = state.busy < NEVER
        pending = state.estimating | self._due
        later = pending | busy | (self.first < NEVER)
        # In the last phase, a pair of each batch is always being matched. A first scene takes the present points:
        # any scene is better than none, and its time helps to forecast the others.
        held = pending & ~state.has_f if self.phase == FILL else pending
        held = held | (self.first < FILL) | (state.busy < FILL)
        if not self.left:
            # No unit begins any more, and it is too late to wait for estimates. A hung job may last until the end.
            held = np.zeros_like(busy)
            later = busy
        has_scene = state.made[:, 0].astype(bool)
        waits = np.where(has_scene, state.by_batch(later), state.by_batch(held)) > 0
        is_matching = self.phase < NEVER or busy.any()
        due = (self.scene_seconds > 0) & ~waits[:, None]
        in_time = self.now + self.scene_seconds <= self.budget.stop_units
        in_time &= ~state.stale[:, None] & (not is_matching)
        due[:, 1:] &= in_time[:, 1:]
        for each in state.making:
            due[each] = False
        # Each batch gets its second candidate before any gets a third.
        batches = np.argsort(has_scene, kind="stable")
        found = [(int(batches[i]), each) for each, i in np.argwhere(due[batches].T).tolist()]
        most = self.crew.beside if is_matching else self.crew.scenes
        return found[: max(0, most - len(state.making))]

    @property
    def is_complete(self) -> bool:
        """Whether all rows have all results that this run can compute, and so do all batches."""
        lacks = self.missing[: self.state.rows].any() or self.lacks_estimate.any()
        return not (lacks or (self.crew.scenes and self.scene_seconds.any()))
