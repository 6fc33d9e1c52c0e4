"""What to do next, by one priority order over the state of all pairs.

:func:`next_work` is a pure function. It has no queue and no memory: it looks at the state, the
costs and the time left whenever a worker is idle.

A unit no longer fits in time by two rules. The time left ends at :attr:`Snapshot.stop`: before the estimates,
scenes and candidates that are still due, for which up to a fifth of the limit is reserved.

- :func:`prefix_that_fits`: its forecast plus the forecasts of the units before it, for all missing pairs, exceed
  the time left of all workers that match. Unless it is the unit of the sweep, it waits for the last phase. A unit
  of stage 2 counts for the share of pairs that need it, and again where new points of stage 1 change its crops.
- :func:`pairs_in_time`: by its mean, one more pair would not end in time. It does not begin, in any phase. Near
  the end, a minibatch is made smaller first.

A forecast is the mean of the latest runs and a margin, 40 % after one and 1 % after many. It is 0 for a unit that
has had no run but its warm-up; the mean is that of the warm-up then.

A job has the expected seconds of its units and the time left. Its worker applies the second rule again before each
minibatch, by its own clock (:class:`mkpc_kaggle.engine.workers.worker.MatchRunner`).

Other work that is dropped when time is short: extra pairs beyond a tenth of it (:func:`pairs_to_connect`), and
candidates that would not end (:func:`candidates_due`). The first candidate of a scene begins unchecked.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.jobs import MatchPlan, Phase
from mkpc_kaggle.engine.plan.blame import MAX_LOSSES, Item
from mkpc_kaggle.engine.plan.budget import ESTIMATE, Budget, Costs
from mkpc_kaggle.engine.plan.state import Mask, State
from mkpc_kaggle.errors import plural
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.recipe import Unit

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
# Phases in arrays are plain integers.
FILL = int(Phase.FILL)
NEVER = int(Phase.NEVER)


@dataclass(frozen=True)
class Crew:
    """The workers of a run: how many match, estimate and reconstruct at a time.

    ``minibatch`` is the number of pairs in a job of matching. ``can_match`` is false if no worker is left for it,
    and ``scenes`` is 0 if none is left for them.
    """

    matchers: int = 1
    estimators: int = 1
    scenes: int = 1
    minibatch: int = 1
    can_match: bool = True


@dataclass(frozen=True, eq=False)
class NextWork:
    """Work for idle workers: the next job of matching, the first estimates that are due, and all scenes
    that are.

    ``done`` of ``total`` pairs are finished in the ``phase``. The first ``fit`` units of the recipe fit for all
    pairs.
    """

    match: MatchPlan | None
    estimates: tuple[int, ...]
    scenes: tuple[str, ...]
    # Of scenes that have their first candidate: (batch, candidate)
    candidates: tuple[tuple[str, str], ...]
    phase: Phase
    done: int
    total: int
    fit: int


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Inputs of the rules below at one moment: the state, and values computed from it once."""

    state: State
    costs: Costs
    budget: Budget
    crew: Crew
    now: float

    @cached_property
    def missing(self) -> Mask:
        """(N, U): see :attr:`State.missing`."""
        return self.state.missing

    @cached_property
    def stop(self) -> float:
        """The time after which no unit may run, so that estimates and scenes have theirs."""
        reserve = estimates_reserve(self) + scenes_reserve(self) + candidates_reserve(self)
        longest = RESERVE_SHARE * self.budget.time_limit
        return self.budget.stop_units - min(reserve, longest)

    @property
    def left(self) -> float:
        return max(0.0, self.stop - self.now)


def next_work(
    state: State,
    costs: Costs,
    budget: Budget,
    crew: Crew,
    now: float,
    lost: Sequence[frozenset[Item]] = (),
) -> NextWork:
    """Return what to do next. ``lost`` are the jobs that the place of the next match job lost since
    its last answer.
    """
    snapshot = Snapshot(state, costs, budget, crew, now)
    fit = prefix_that_fits(snapshot)
    connecting = pairs_to_connect(snapshot)
    phases = phases_of(snapshot, fit, connecting)
    wanted = phases.copy(order="F")
    for number, unit in enumerate(state.units):
        if pairs_in_time(snapshot, unit) <= 1:
            wanted[:, number] = NEVER
    # The most urgent phase of each pair, and of the pairs that no worker has now
    first = wanted.min(1)
    best = np.where(state.matching, np.int8(NEVER), first)
    phase = Phase(int(best.min(initial=NEVER)))
    match = None
    if phase is not Phase.NEVER and crew.can_match:
        # A job takes the units of its phase and of earlier phases, which other pairs have finished.
        match = trial_plan(snapshot, wanted, lost) if lost else None
        if match is None:
            match = match_plan(snapshot, phase, wanted <= phase, best == phase)
    is_matching = match is not None or bool(state.matching.any())
    estimates = estimates_due(snapshot, first)
    scenes = scenes_due(snapshot, phase, first, estimates, is_matching=is_matching)
    # The share of the phase that is done. Pairs under way are not done.
    pairs = phases[: state.rows]
    total = state.rows
    if phase is Phase.CONNECT:
        pairs = phases[state.rows :]
        total = int(connecting.sum())
    pending = int((pairs.min(1) <= phase).sum()) if pairs.size else 0
    order = tuple(estimates[:MAX_DUE].tolist())
    candidates = candidates_due(snapshot, estimates, is_matching=is_matching)
    return NextWork(match, order, scenes, candidates, phase, total - pending, total, fit)


# Matching


def phases_of(snapshot: Snapshot, fit: int, connecting: Mask) -> NDArray[Any]:
    """Return the phase (N, U) of each pair's missing units; ``NEVER`` for the other units."""
    state = snapshot.state
    phases = np.full(snapshot.missing.shape, NEVER, np.int8, order="F")
    rows = phases[: state.rows]
    for number in range(len(state.units)):
        rows[:, number] = Phase.DEEPEN if number < fit else FILL
        if state.is_crop[number]:
            # Points from older crops are worth more than none: better crops come last.
            rows[state.has[: state.rows, number], number] = FILL
    # Last, since the sweep may be any unit of the prefix.
    sweep = sweeping_unit(state)
    rows[:, sweep] = Phase.SWEEP
    phases[state.rows :, sweep][connecting] = Phase.CONNECT
    # A pair that cost two workers may cost two more for each unit, so all others come first.
    phases[state.costly] = np.maximum(phases[state.costly], FILL)
    phases[~snapshot.missing] = NEVER
    return phases


def sweeping_unit(state: State) -> int:
    """Return the number of the first unit that can run, of stage 1 if possible."""
    # A unit of stage 2 without points of stage 1 looks at whole images.
    usable = np.flatnonzero(~state.unusable)
    first = usable[~state.is_crop[usable]]
    return int(next(iter([*first, *usable]), 0))


def prefix_that_fits(snapshot: Snapshot) -> int:
    """Return the length of the longest prefix of the recipe that all rows can have in the time
    left.
    """
    left = snapshot.left * snapshot.crew.matchers
    if left <= 0:  # an unmeasured unit needs no time, but fits no more
        return 0
    return int(np.searchsorted(seconds_of_prefixes(snapshot), left, side="right"))


def pairs_in_time(snapshot: Snapshot, unit: Unit) -> float:
    """Return on how many pairs, one after the other, a unit would end in time.

    Infinite for an unmeasured unit, as long as there is time: its cost is learnt from its first run.
    """
    if not snapshot.left:
        return 0.0
    mean = snapshot.costs.mean(unit.name)
    return snapshot.left / mean if mean else inf


def seconds_of_prefixes(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return the seconds (U,) of one worker for the missing units of each prefix of the recipe."""
    state = snapshot.state
    # Extra pairs are left out: they have a share of the time, not a claim.
    missing = snapshot.missing[: state.rows]
    forecasts = np.array([snapshot.costs.forecast(unit.name) for unit in state.units])
    forecasts *= state.need_shares
    count = len(state.units)
    seconds = missing.sum(0) * forecasts
    # New points of stage 1 give new crops, so the units of stage 2 run again in the same prefix.
    missed = np.full(state.rows, count)  # the first missing unit of stage 1
    for number in np.flatnonzero(~state.is_crop)[::-1].tolist():
        missed[missing[:, number]] = number
    for number in np.flatnonzero(state.is_crop).tolist():
        again = state.current[: state.rows, number] & (missed < count)
        prefixes = np.maximum(missed[again], number)
        seconds += np.bincount(prefixes, minlength=count) * forecasts[number]
    return np.asarray(np.cumsum(seconds))


def pairs_to_connect(snapshot: Snapshot) -> Mask:
    """Return an (N - rows,) mask of the extra pairs that fit in a tenth of the time, the most
    useful first.
    """
    state = snapshot.state
    count = len(state.pairs) - state.rows
    if not count:
        return np.zeros(0, bool)
    sweep = sweeping_unit(state)
    # A share of the time after the sweep, as it was before the first extra pair.
    had = state.current[state.rows :, sweep]
    seconds = snapshot.costs.forecast(state.units[sweep].name) / snapshot.crew.matchers
    most = CONNECT_SHARE * (snapshot.left + had.sum() * seconds)
    return np.asarray(np.arange(1, count + 1) * seconds <= most)


def match_plan(snapshot: Snapshot, phase: Phase, missing: Mask, ready: Mask) -> MatchPlan:
    """Return a plan for the first pair, or on a GPU for a minibatch of pairs with the same missing
    units.
    """
    state = snapshot.state
    order = state.order[ready[state.order]]
    # In visiting order, for the cache of encodings; in the last phase the weakest pairs first.
    if phase is Phase.FILL:
        order = order[np.argsort(state.inliers[order], kind="stable")]
        order = order[np.argsort(state.costly[order], kind="stable")]
    first = first_pair(snapshot, order, missing)
    # Stage 1 first, because the crops come from its points.
    numbers = np.flatnonzero(missing[first]).tolist()
    numbers.sort(key=state.is_crop.__getitem__)
    units = [state.units[number] for number in numbers]
    # A unit that was lost before runs alone, so that another loss has one cause.
    alone = any(("unit", first, unit.name) in state.tries.alone for unit in units)
    size = 1 if alone else snapshot.crew.minibatch
    # Near the end, a smaller minibatch still ends in time.
    size = max(1, int(min(size, pairs_in_time(snapshot, units[0]))))
    indices = (first,)
    if size > 1:
        alike = order[(missing[order] == missing[first]).all(1)]
        # In a minibatch, a suspect would cost the other pairs another try.
        alike = alike[~np.isin(alike, [first, *suspect_pairs(state)])]
        indices = (first, *alike[: size - 1].tolist())
    # An unmeasured unit counts as infinitely long, so its cost is learnt from a job of one unit.
    seconds = [
        snapshot.costs.mean(unit.name) if snapshot.costs.is_known(unit.name) else inf
        for unit in units
    ]
    fits = np.cumsum(seconds) * len(indices) < JOB_SHARE * snapshot.left
    chosen = tuple(units[: 1 if alone else max(1, int(fits.sum()))])
    return plan_of(snapshot, phase, indices, chosen, is_last=len(chosen) == len(units))


def plan_of(
    snapshot: Snapshot,
    phase: Phase,
    indices: Sequence[int],
    units: Sequence[Unit],
    *,
    is_last: bool = True,
    is_check: bool = False,
) -> MatchPlan:
    """Return the plan to run these units on these pairs, with their expected seconds."""
    expected = tuple(snapshot.costs.mean(unit.name) for unit in units)
    return MatchPlan(
        phase, tuple(indices), tuple(units), expected, snapshot.left, is_last, is_check
    )


def first_pair(snapshot: Snapshot, order: NDArray[Any], missing: Mask) -> int:
    """Return the first pair in an order, or one that distinguishes a bad pair from a bad unit.

    A unit that never ran, and was lost on a pair, runs next on a pair where other units ran.
    """
    state = snapshot.state
    first = int(order[0])
    unproven = [n for n, unit in enumerate(state.units) if not snapshot.costs.mean(unit.name)]
    if not unproven or not state.costly.any():
        return first
    lost = {unit for _, unit in state.given_up_units()}
    if any(missing[first, n] and state.units[n].name in lost for n in unproven):
        has_points = order[state.has[order].any(1)]
        return int(has_points[0] if has_points.size else order[order.size // 2])
    return first


def suspect_pairs(state: State) -> list[int]:
    """Return the pairs with a unit that was lost before."""
    found = []
    for item in state.tries.alone:
        match item:
            case ("unit", int(index), _):
                found.append(index)
    return found


def trial_plan(
    snapshot: Snapshot, wanted: NDArray[Any], lost: Sequence[frozenset[Item]]
) -> MatchPlan | None:
    """Return a plan for a place that ``lost`` jobs since its last answer, or ``None`` if any job will
    do.

    ``wanted`` (N, U) are phases. Another loss must say whether the place is at fault. So after a
    first loss the place gets other pairs, and after a second one an item that worked before:
    several bad pairs in a row must not close a place. Before any item worked, the place gets
    another pair and another unit, since a unit may fail on all pairs.
    """
    state = snapshot.state
    others = wanted.copy(order="F")
    others[state.matching] = NEVER
    # No unit of a suspect pair: without points of stage 1, a crop is the whole image, on which the same
    # matcher fails in the same way.
    for index in suspect_pairs(state):
        others[index] = NEVER
    phase = Phase(int(others.min(initial=NEVER)))
    tried = frozenset[Item]().union(*lost)
    proven = [item for item in state.tries.proven if item not in tried]
    if proven and (len(lost) > 1 or phase is Phase.NEVER):
        return check_plan(snapshot, proven[-1])
    if phase is Phase.NEVER:
        return None
    if not state.tries.proven:
        return unlike_plan(snapshot, others, lost)
    return match_plan(snapshot, phase, others <= phase, others.min(1) == phase)


def check_plan(snapshot: Snapshot, item: Item) -> MatchPlan:
    """Return a plan that repeats an item, to see whether a place works."""
    _, index, name = item
    assert isinstance(index, int)
    unit = next(unit for unit in snapshot.state.units if unit.name == name)
    return plan_of(snapshot, Phase.SWEEP, [index], [unit], is_check=True)


def unlike_plan(
    snapshot: Snapshot, wanted: NDArray[Any], lost: Sequence[frozenset[Item]]
) -> MatchPlan:
    """Return a plan of a unit and a pair that were not lost, if there are any."""
    state = snapshot.state
    lost_pairs = set()
    lost_units = set()
    for job in lost:
        for item in job:
            match item:
                case ("unit", int(pair), str(name)):
                    lost_pairs.add(pair)
                    lost_units.add(name)
    available = [n for n in range(len(state.units)) if (wanted[:, n] < NEVER).any()]
    # Units of stage 1 first, since the others need their points.
    number = min(available, key=lambda n: (state.units[n].name in lost_units, state.is_crop[n]))
    order = state.order[wanted[state.order, number] < NEVER]
    new = order[~np.isin(order, list(lost_pairs))]
    if new.size:
        order = new
    # Far from the lost pairs: neighbours have an image in common. A place may have lost more jobs than
    # count against it.
    losses = min(len(lost), MAX_LOSSES)
    index = int(order[(order.size - 1) * losses // MAX_LOSSES])
    unit = state.units[number]
    phase = Phase(int(wanted[index, number]))
    return plan_of(snapshot, phase, [index], [unit])


def upcoming_pairs(
    state: State, plan: MatchPlan, count: int, open_pairs: Mask | None = None
) -> list[int]:
    """Return the pairs that will probably be matched after a plan's.

    ``open_pairs`` (N,) are the ones that may be; default: all.
    """
    # In the last phase, the order depends on inliers that come meanwhile.
    if plan.phase is Phase.FILL:
        return []
    last = plan.indices[-1]
    rank = int(np.flatnonzero(state.order == last)[0]) + 1
    following = state.order[rank:]
    if open_pairs is not None:
        following = following[open_pairs[following]]
    return [int(index) for index in following[:count]]


# Estimates and scenes


def estimates_due(snapshot: Snapshot, first: NDArray[Any]) -> NDArray[Any]:
    """Return the rows to estimate now: first rows without any F, then rows with all units that fit
    in time.

    ``first`` (N,) is the phase of each pair's next unit.
    """
    state = snapshot.state
    # A settled pair gets no other unit soon. A pair without an F is estimated at once: any F is better
    # than the fallback.
    is_settled = (first >= FILL) & ~state.matching
    has_f = state.has_own | state.has_earlier
    due = state.lacks_estimate & ~state.estimating & (is_settled | ~has_f)
    order = state.order[due[state.order]]
    return np.asarray(order[np.argsort(has_f[order], kind="stable")])


def scenes_due(
    snapshot: Snapshot,
    phase: Phase,
    first: NDArray[Any],
    estimates: NDArray[Any],
    *,
    is_matching: bool,
) -> tuple[str, ...]:
    """Return the batches to reconstruct now; batches without any scene come first.

    A batch's first scene waits for the units that fit in time, later scenes for all units until
    matching ends.
    """
    state = snapshot.state
    waiting = waiting_batches(state, snapshot.crew)
    if not waiting:
        return ()
    pending = state.estimating.copy()
    pending[estimates] = True
    for_first, for_later = pairs_to_await(snapshot, phase, first, pending, is_matching=is_matching)
    blocked = {
        False: batches_with(state, for_first),
        True: batches_with(state, for_later),
    }
    # Stable, so batches in the same position keep their order.
    order = sorted(waiting, key=state.scenes.in_use.__contains__)
    return tuple(
        batch for batch in order if not blocked[batch in state.scenes.in_use][state.batches[batch]]
    )


def pairs_to_await(
    snapshot: Snapshot,
    phase: Phase,
    first: NDArray[Any],
    pending: Mask,
    *,
    is_matching: bool,
) -> tuple[Mask, Mask]:
    """Return two masks (N,) of pairs to wait for: before a batch's first scene, and before a later
    one.

    ``pending`` (N,) are the pairs whose estimate is due or under way.
    """
    state = snapshot.state
    if snapshot.now >= snapshot.stop:
        # No unit begins any more, and it is too late to wait for estimates. A hung job may last until
        # the end, so a first scene does not wait for its pairs.
        return np.zeros_like(pending), state.matching
    if not is_matching:
        return pending, pending
    for_first = first < FILL
    if phase < FILL:
        for_first |= pending | state.matching
    else:
        # In this phase, a pair of each batch is always being matched. A first scene takes the present points:
        # any scene is better than none, and its time helps to forecast the others.
        for_first |= (pending & ~state.has_own) | (state.matching & ~state.filling)
    return for_first, pending | state.matching | (first < NEVER)


def candidates_due(
    snapshot: Snapshot, estimates: NDArray[Any], *, is_matching: bool
) -> tuple[tuple[str, str], ...]:
    """Return the further candidates to make now, as (batch, candidate).

    They wait for the end of matching, and are made only if they are expected to end in time.
    """
    state = snapshot.state
    if is_matching or not snapshot.crew.scenes:
        return ()
    pending = state.estimating.copy()
    pending[estimates] = True
    blocked = batches_with(state, pending)
    due = []
    for batch, number in state.batches.items():
        if batch in state.scenes.stale or batch in state.scenes.reconstructing or blocked[number]:
            continue
        for candidate in state.scenes.untried.get(batch, ()):
            end = snapshot.now + candidate_seconds(snapshot, batch, candidate)
            if (batch, candidate) not in state.scenes.trying and end <= snapshot.budget.stop_units:
                due.append((batch, candidate))
    # Each batch gets its second candidate before any gets a third.
    due.sort(key=lambda each: state.scenes.candidates.index(each[1]))
    return tuple(due)


def candidate_seconds(snapshot: Snapshot, batch: str, candidate: str) -> float:
    """Return the expected seconds of a candidate."""
    matches = snapshot.state.matches_of_candidate(batch, candidate)
    return snapshot.costs.scene(matches)


def candidates_reserve(snapshot: Snapshot) -> float:
    """Return the seconds to reserve for further candidates of scenes, several at a time."""
    scenes = snapshot.state.scenes
    if len(scenes.candidates) == 1 or not snapshot.crew.scenes:
        return 0.0
    seconds = 0.0
    for batch in snapshot.state.batches:
        # A stale batch will get all of them.
        missing = scenes.candidates[1:] if batch in scenes.stale else scenes.untried.get(batch, ())
        seconds += sum(candidate_seconds(snapshot, batch, candidate) for candidate in missing)
    return min(CANDIDATES_SHARE * snapshot.budget.time_limit, seconds / snapshot.crew.scenes)


def batches_with(state: State, pairs: Mask) -> Mask:
    """Return a (B,) mask of the batches of these pairs."""
    found = np.zeros(len(state.batches), bool)
    numbers = state.batch_of[pairs]
    found[numbers[numbers >= 0]] = True
    return found


def waiting_batches(state: State, crew: Crew) -> list[str]:
    """Return the batches to reconstruct at some time, in their order."""
    stale = state.scenes.stale - state.scenes.reconstructing
    if not stale or not crew.scenes:
        return []
    matches = state.matches_of_batches()
    return [batch for batch, number in state.batches.items() if batch in stale and matches[number]]


def estimates_reserve(snapshot: Snapshot) -> float:
    """Return the expected seconds of the pending estimates."""
    count = int(snapshot.state.lacks_estimate.sum())
    return snapshot.costs.mean(ESTIMATE) * count / snapshot.crew.estimators


def scenes_reserve(snapshot: Snapshot) -> float:
    """Return the expected seconds of the pending reconstructions, several at a time."""
    state = snapshot.state
    if not state.scenes.stale or not snapshot.crew.scenes:
        return 0.0
    stale = [state.batches[batch] for batch in state.scenes.stale]
    forecasts = snapshot.costs.scenes(state.matches_of_batches()[stale])
    return float(max(forecasts.max(), forecasts.sum() / snapshot.crew.scenes))


# The end, and the outlook


def is_complete(state: State, crew: Crew) -> bool:
    """Whether all rows have all results that this run can compute, and so do all batches."""
    if state.missing[: state.rows].any() or state.lacks_estimate.any():
        return False
    has_untried = crew.scenes and any(state.scenes.untried.values())
    return not waiting_batches(state, crew) and not has_untried


def outlook(state: State, costs: Costs, budget: Budget, crew: Crew, now: float) -> str:
    """Return how long all missing units would take, and how many units fit in the time left.

    Empty until each unit was measured.
    """
    usable = [unit for unit, lost in zip(state.units, state.unusable, strict=True) if not lost]
    if not all(costs.is_known(unit.name) for unit in usable):
        return ""
    snapshot = Snapshot(state, costs, budget, crew, now)
    seconds = seconds_of_prefixes(snapshot)[-1] / crew.matchers
    text = f"all units on all pairs would take {format_duration(seconds)}"
    if not isfinite(snapshot.stop):
        return f"{text}; there is no time limit"
    fit = min(prefix_that_fits(snapshot), len(usable))
    left = format_duration(snapshot.left)
    return f"{text}; {fit} of {plural(len(usable), 'unit')} can run in the remaining {left}"
