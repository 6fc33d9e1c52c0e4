"""What to do next: one pure function of the state of all pairs, the costs and the time.

:func:`plan` has no queue and no memory. A unit no longer fits in time by two rules. The time left ends before the
estimates, scenes and candidates that are still due, for which up to a fifth of the limit is reserved.

- The prefix that fits: a unit whose forecast, with those of the units before it, for all missing pairs exceeds the
  time left of all workers waits for the last phase, unless it is the unit of the sweep. A unit of stage 2 counts
  for the share of pairs that need it.
- By its mean, one more pair would not end in time: the unit does not begin, in any phase, nor does a crop that
  depends on it. Near the end, a minibatch is made smaller first.

A forecast is the mean of the latest runs and a margin, 40 % after one and 1 % after many. It is 0 for a unit that
has had no run but its warm-up; the mean is that of the warm-up then. A worker applies the second rule again before
each minibatch, by its own clock (:class:`mkpc_kaggle.engine.worker.MatchRunner`).
"""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.budget import COST_OF_ESTIMATES, Budget, Costs
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
from mkpc_kaggle.scene.candidates import ALL_UNITS

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

Phases = NDArray[np.int8]


@dataclass(frozen=True)
class Crew:
    """The workers of a run: how many match, estimate and reconstruct at a time; 0 if none is left.

    ``minibatch`` is the number of pairs in a job of matching.
    """

    matchers: int = 1
    estimators: int = 1
    scenes: int = 1
    minibatch: int = 1


@dataclass(frozen=True)
class MatchPlan:
    """Missing ``units`` on ``pairs``, one or a minibatch, by their numbers.

    ``expected`` are the seconds of each unit on a pair, and ``seconds`` those that are left. ``upcoming`` are the
    pairs that will probably follow.
    """

    phase: int
    pairs: list[int]
    units: list[int]
    expected: list[float]
    seconds: float
    upcoming: list[int]


@dataclass(frozen=True)
class NextWork:
    """Work for idle workers: the next job of matching, the first estimates that are due, and all scenes, as
    (batch, candidate). The first ``fit`` units of the recipe fit for all pairs.
    """

    match: MatchPlan | None
    estimates: list[int]
    scenes: list[tuple[int, str]]
    fit: int


def plan(
    state: State, costs: Costs, budget: Budget, crew: Crew, now: float, lost: int = 0
) -> NextWork:
    """Return what to do next. ``lost`` counts the jobs that the asking place lost since its last answer."""
    left = time_left(state, costs, budget, crew, now)
    missing = state.missing
    fit = prefix_that_fits(state, missing, costs, crew, left)
    phases = phases_of(state, missing, fit, extra_share(state, costs, crew, left))
    means = np.array([costs.mean(unit.name) for unit in state.units])
    wanted = in_time(state, missing, phases, means, left)
    first = wanted.min(1)
    ready = np.where(state.busy == NEVER, first, NEVER)
    phase = int(ready.min(initial=NEVER))
    match = None
    if phase < NEVER and crew.matchers:
        # A job takes the units of its phase and of earlier phases, which other pairs have finished.
        order = order_of(state, ready == phase, phase, lost)
        match = job_of(state, costs, crew, order, wanted <= phase, phase, left, lost)
    estimates = estimates_due(state, crew, first)
    scenes: list[tuple[int, str]] = []
    if crew.scenes:
        pending = state.estimating.copy()
        pending[estimates] = True
        is_matching = match is not None or bool((state.busy < NEVER).any())
        held = pairs_held(state, pending, first, phase, left, is_matching=is_matching)
        # Further candidates wait for the end of matching, and must be expected to end in time.
        most = -inf if is_matching else budget.stop_units - now
        for batch, name in scenes_due(state, *map(state.batches_with, held)):
            seconds = costs.scene(state.matches_of_candidate(batch, name))
            if name == ALL_UNITS or seconds <= most:
                scenes.append((batch, name))
    return NextWork(match, estimates[:MAX_DUE].tolist(), scenes, fit)


def time_left(state: State, costs: Costs, budget: Budget, crew: Crew, now: float) -> float:
    """Return the seconds until no unit may run, so that estimates, scenes and candidates have theirs."""
    waiting = int(state.lacks_estimate.sum())
    seconds = costs.mean(COST_OF_ESTIMATES) * waiting / max(1, crew.estimators)
    if crew.scenes and state.batches:
        forecasts = costs.scenes(state.matches_of_batches)
        due = forecasts[[state.may_make(batch) for batch in range(len(state.batches))]]
        seconds += max(due.max(initial=0.0), due.sum() / crew.scenes)
        others = 0.0
        if len(state.candidates) > 1:
            for batch in range(len(state.batches)):
                for candidate in state.untried(batch):
                    others += costs.scene(state.matches_of_candidate(batch, candidate))
        seconds += min(CANDIDATES_SHARE * budget.time_limit, others / crew.scenes)
    reserve = min(seconds, RESERVE_SHARE * budget.time_limit)
    return max(0.0, budget.stop_units - reserve - now)


# Matching


def prefix_that_fits(state: State, missing: Mask, costs: Costs, crew: Crew, left: float) -> int:
    """Return the length of the longest prefix of the recipe that all rows can have in the time
    left.
    """
    if left <= 0:  # an unmeasured unit needs no time, but fits no more
        return 0
    # Extra pairs are left out: they have a share of the time, not a claim.
    rows = slice(state.rows)
    forecasts = np.array([costs.forecast(unit.name) for unit in state.units])
    # The share of the known pairs that need a unit, and one more that needs it
    needed = (state.used[rows].sum(0) + 1) / (state.done[rows].sum(0) + 1)
    seconds = np.cumsum(missing[rows].sum(0) * forecasts * needed)
    return int(np.searchsorted(seconds, left * max(1, crew.matchers), side="right"))


def extra_share(state: State, costs: Costs, crew: Crew, left: float) -> int:
    """Return the number of extra pairs that fit in a tenth of the time, the most useful first."""
    seconds = costs.forecast(state.units[state.sweep].name) / max(1, crew.matchers)
    if not seconds or not isfinite(left):
        return len(state.pairs)
    # A share of the time after the sweep, as it was before the first extra pair
    had = int(state.done[state.rows :, state.sweep].sum())
    return int(CONNECT_SHARE * (left + had * seconds) / seconds)


def phases_of(state: State, missing: Mask, fit: int, extra: int) -> Phases:
    """Return the phase (N, U) of each pair's missing units; ``NEVER`` for the other units."""
    phases = np.full(missing.shape, NEVER, np.int8, order="F")
    phases[: state.rows, :fit] = DEEPEN
    phases[: state.rows, fit:] = FILL
    phases[: state.rows, state.sweep] = SWEEP
    phases[state.rows : state.rows + extra, state.sweep] = CONNECT
    # A pair that cost two workers may cost two more for each unit, so all others come first.
    costly = (state.losses[:, :-1] == GIVEN_UP).any(1)
    phases[costly] = np.maximum(phases[costly], FILL)
    phases[~missing] = NEVER
    return phases


def in_time(
    state: State, missing: Mask, phases: Phases, means: NDArray[Any], left: float
) -> Phases:
    """Return the phases (N, U) without units that would not end in time, and without crops that depend on them."""
    wanted = phases.copy(order="F")
    wanted[:, (means >= left) | (left <= 0)] = NEVER
    for unit in np.flatnonzero(state.is_crop).tolist():
        never = missing[:, :unit] & (wanted[:, :unit] == NEVER)
        wanted[(never & ~state.is_crop[:unit]).any(1), unit] = NEVER
    return wanted


def order_of(state: State, ready: Mask, phase: int, lost: int) -> NDArray[np.int_]:
    """Return the pairs that are ready in their order: visiting order, for the cache of encodings, and in the
    last phase the weakest first. Suspects, with a lost job, come last.

    A place that has lost jobs continues a third of the order further, because neighbours share an image.
    """
    order = state.order[ready[state.order]]
    if phase == FILL:
        order = order[np.argsort(state.inliers[order], kind="stable")]
    suspect = (state.losses[order, :-1] > 0).any(1)
    fresh = order[~suspect]
    fresh = np.roll(fresh, -(len(fresh) * min(lost, 2) // 3))
    return np.concatenate([fresh, order[suspect]])


def job_of(
    state: State,
    costs: Costs,
    crew: Crew,
    order: NDArray[np.int_],
    wanted: Mask,
    phase: int,
    left: float,
    lost: int,
) -> MatchPlan:
    """Return a job for the first pair of an order, or on a GPU for a minibatch of pairs with the same wanted
    units (N, U).

    A suspect and a place that lost its latest job get one unit on one pair, so that another loss has one cause.
    """
    first = int(order[0])
    numbers = np.flatnonzero(wanted[first]).tolist()
    names = [state.units[number].name for number in numbers]
    expected = list(map(costs.mean, names))
    pairs = [first]
    if lost or state.losses[first, :-1].any():
        numbers = numbers[:1]
    else:
        # Near the end, a smaller minibatch still ends in time.
        fits = left / expected[0] if expected[0] else inf
        size = max(1, int(min(crew.minibatch, fits)))
        if size > 1:
            near = order[: NEIGHBOURS * size]
            alike = (wanted[near] == wanted[first]).all(1) & ~state.losses[near, :-1].any(1)
            pairs = near[alike][:size].tolist()
        # An unmeasured unit counts as infinitely long, so its cost is learnt from a job of one unit.
        known = [costs.mean(name) if costs.is_known(name) else inf for name in names]
        count = int((np.cumsum(known) * len(pairs) < JOB_SHARE * left).sum())
        numbers = numbers[: max(1, count)]
    # In the last phase, the order depends on inliers that come meanwhile.
    upcoming = [] if phase == FILL else order[len(pairs) : len(pairs) + crew.minibatch].tolist()
    return MatchPlan(phase, pairs, numbers, expected[: len(numbers)], left, upcoming)


# Estimates and scenes


def estimates_due(state: State, crew: Crew, first: Phases) -> NDArray[np.int_]:
    """Return the rows to estimate now: first rows without any F, then rows with all units that fit
    in time; those with a lost job last.

    ``first`` (N,) is the phase of each pair's next unit.
    """
    # A settled pair gets no other unit soon. A pair without an F is estimated at once: any F is better
    # than the fallback.
    settled = (first >= FILL) & (state.busy == NEVER)
    due = state.lacks_estimate & ~state.estimating & (settled | ~state.has_f)
    due &= bool(crew.estimators)
    order = state.order[due[state.order]]
    rank = state.has_f[order] + 2 * (state.losses[order, ESTIMATE] > 0)
    return np.asarray(order[np.argsort(rank, kind="stable")])


def pairs_held(
    state: State,
    pending: Mask,
    first: Phases,
    phase: int,
    left: float,
    *,
    is_matching: bool,
) -> tuple[Mask, Mask]:
    """Return the pairs (N,) for which scenes of their batches wait: the first scene, and later ones.

    A first scene waits for units that fit in time and for estimates (``pending``), later scenes for all units
    until matching ends.
    """
    busy = state.busy < NEVER
    if not left:
        # No unit begins any more, and it is too late to wait for estimates. A hung job may last until the end.
        return np.zeros_like(pending), busy
    if not is_matching:
        return pending, pending
    held = (first < FILL) | (state.busy < FILL)
    # In the last phase, a pair of each batch is always being matched. A first scene takes the present points: any
    # scene is better than none, and its time helps to forecast the others.
    held |= pending if phase < FILL else pending & ~state.has_f
    return held, pending | busy | (first < NEVER)


def scenes_due(state: State, held: Mask, held_later: Mask) -> list[tuple[int, str]]:
    """Return the scenes to make, as (batch, candidate); batches without any scene come first.

    The batches (B,) that are ``held`` wait.
    """
    due = []
    for batch in np.flatnonzero(state.matches_of_batches).tolist():
        if state.may_make(batch):
            if not (held_later if state.made[batch] else held)[batch]:
                due.append((batch, ALL_UNITS))
        elif state.made[batch] and not (state.stale[batch] or held_later[batch]):
            due += [(batch, candidate) for candidate in state.untried(batch)]
    # Each batch gets its second candidate before any gets a third.
    due.sort(key=lambda each: (state.candidates.index(each[1]), bool(state.made[each[0]])))
    return [each for each in due if each not in state.making]


# The end


def is_complete(state: State, crew: Crew) -> bool:
    """Whether all rows have all results that this run can compute, and so do all batches."""
    if state.missing[: state.rows].any() or state.lacks_estimate.any():
        return False
    nobody = np.zeros(len(state.batches), bool)
    return not (crew.scenes and scenes_due(state, nobody, nobody))
