"""The planner: what to do next, and why; decisions on values, without threads or clocks.

It looks at a job's worth of pairs at a time, so that a hundred thousand pairs cost no more to plan than ten.
"""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from mkpc_kaggle.engine.budget import Budget, Costs, format_duration, needs
from mkpc_kaggle.engine.jobs import (
    Cause,
    Finished,
    Lost,
    Outcome,
    Phase,
    Plan,
    Record,
    Stretch,
    UnitRecord,
    chunks,
)
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.patience import Patience
from mkpc_kaggle.engine.upgrade import Rounds, inliers_before, is_weak
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.stages import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit

EXPLORE_SHARE = 0.25
"""The share of the time left that may be spent to learn what units cost that never ran."""
JOB_SHARE = 0.05
"""The share of the time left that a job may be expected to take: what a job found late comes too late."""
DEADLINE_SHARE = 0.5
"""The share of the time left after which a job begins no unit: where all is slower of a sudden, that is learnt."""

MOST_DOUBLINGS = 3
"""Of the silence that a job is allowed, while one job after the other hangs."""


@dataclass(frozen=True)
class Explanation:
    """A decision, and why; ``seconds`` since the run's start."""

    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


class Planner:
    """Sweep, deepen, upgrade, over the pairs of ``order``.

    ``records`` (one a pair, by index) are the state that it decides upon; it alone changes them. ``workers``
    work at a time.
    """

    def __init__(
        self,
        order: Sequence[int],
        recipe: Recipe,
        records: list[Record],
        budget: Budget,
        workers: int = 1,
        patience: Patience | None = None,
    ) -> None:
        self.recipe = recipe
        self.records = records
        self.budget = budget
        self.workers = workers
        self.patience = patience or Patience()
        self.costs = Costs()
        self.explanations: list[Explanation] = []
        self.phase = Phase.SWEEP
        self._order = order
        self._phases = iter((self._sweep, self._deepen, self._upgrade))
        self._queue: deque[Stretch] = deque()
        self._again: deque[Stretch] = deque()
        self._flying: set[int] = set()
        self._jobs_out = self._exploring = 0
        self._allowance = 0.0
        self._last_event = budget.clock()
        self._pairs_of_phase = self._pairs_queued = 0
        self._fitting = -1
        self._rounds = Rounds(recipe.upgrade)
        self._losses = Losses()
        self._aside: set[int] = set()
        self._hung_in_a_row = 0
        self._lacking: Counter[str] = Counter()
        for record in records:
            if record.units:
                self._lacking.update(unit.name for unit in record.lacking(recipe.regular))

    # What to do next

    def next(self, now: float) -> Plan | None:
        """The next plan; ``None`` where there is nothing to do, or nothing before a job comes back."""
        if now >= self.budget.stop:
            return None
        while (stretch := self._turn(now)) is not None:
            units = self._units(stretch, now)
            todo = [index for index in stretch.indices if self._can_gain(index, units)]
            lacking = list(dict.fromkeys(unit for index in todo for unit in self.records[index].lacking(units)))
            unknown = not all(self.costs.known(unit.name) for unit in lacking)
            if unknown and (self._exploring >= self.workers or self._jobs_out > self.workers):
                # What has no known cost cannot be planned: one try a worker, not long behind another job.
                self._again.appendleft(stretch)
                return None
            if todo:
                return self._plan(stretch, todo, units, lacking, now, unknown=unknown)
        return None

    def _turn(self, now: float) -> Stretch | None:
        """Take the next stretch out whose pairs are all back."""
        for stretch in self._again:
            if self._flying.isdisjoint(stretch.indices):
                self._again.remove(stretch)
                return stretch
        while not self._queue:
            if not self._open_phase(now):
                return None
        if not self._flying.isdisjoint(self._queue[0].indices) or not self._round_may_begin(self._queue[0], now):
            return None
        stretch = self._queue.popleft()
        self._pairs_queued -= len(stretch.indices)
        return stretch

    def _plan(
        self,
        stretch: Stretch,
        todo: list[int],
        units: tuple[Unit, ...],
        lacking: Sequence[Unit],
        now: float,
        *,
        unknown: bool,
    ) -> Plan:
        """A plan for the first of the pairs; the others go back to the front of the queue.

        It is one pair where some unit's cost is unknown and cannot be planned, and few where it gets late; in
        the end the first of its units, since what one job does comes back, or is lost, at once.
        """
        left = self.budget.stop - now
        seconds = self.costs.overhead + sum(self.costs.of(unit.name) for unit in lacking)
        most = len(todo) if len(todo) * seconds <= JOB_SHARE * left else max(1, int(JOB_SHARE * left / seconds))
        most = 1 if unknown else most
        if todo[most:]:
            self._again.appendleft(replace(stretch, indices=tuple(todo[most:])))
        todo = todo[:most]
        if not unknown and len(lacking) > 1 and seconds > JOB_SHARE * left:
            first, *rest = sorted(lacking, key=lambda unit: unit.stage)
            self._again.appendleft(replace(stretch, indices=tuple(todo), units=tuple(rest)))
            units = lacking = (first,)
        self._flying.update(todo)
        self._jobs_out += 1
        self._exploring += unknown
        self._allowance = EXPLORE_SHARE * left
        if self._jobs_out == 1:
            self._last_event = now
        return Plan(
            stretch.phase,
            tuple(todo),
            units,
            tuple(self.costs.most(unit.name) for unit in units),
            now + self._allowance if unknown else self._deadline(lacking, len(todo), now),
            self._timeout(lacking, len(todo), unknown=unknown),
            stretch.shrink,
            unknown,
        )

    def _timeout(self, lacking: Sequence[Unit], pairs: int, *, unknown: bool) -> float:
        """Twice as long after each job that hung with none ended since: it may be the machine that is slow."""
        allowance = self._allowance if unknown else None
        timeout = self.patience.timeout(lacking, pairs, self.costs, self.budget.limit, allowance)
        return timeout * (1 << min(self._hung_in_a_row, MOST_DOUBLINGS))

    def _deadline(self, lacking: Iterable[Unit], pairs: int, now: float) -> float:
        """Early enough to plan the rest anew, but late enough for twice what the job should take."""
        seconds = pairs * (self.costs.overhead + sum(self.costs.most(unit.name) for unit in lacking))
        return min(self.budget.stop, now + max(DEADLINE_SHARE * (self.budget.stop - now), 2 * seconds))

    def _can_gain(self, index: int, units: Iterable[Unit]) -> bool:
        return index not in self._aside and bool(self.records[index].lacking(units))

    def _units(self, stretch: Stretch, now: float) -> tuple[Unit, ...]:
        """The units for a stretch whose turn has come."""
        if stretch.units is None:
            regular = self._possible(self.recipe.regular)
            units = regular[: self._fit(regular, now)]
        else:
            units = self._possible(stretch.units)
        if stretch.phase is Phase.SWEEP:
            return units[:1]
        return tuple(unit for unit in units if self.costs.most(unit.name) < self.budget.stop - now)

    def _possible(self, units: Iterable[Unit]) -> tuple[Unit, ...]:
        return tuple(unit for unit in units if unit.name not in self._losses.hopeless)

    def _fit(self, units: tuple[Unit, ...], now: float) -> int:
        """How many units all pairs can have in the time left; a change is explained."""
        left = (self.budget.stop - now) * self.workers
        count, short = len(units), 0.0
        for number, needed in enumerate(needs(units, self._lacking, self.costs)):
            if needed > left:
                count, short = number, needed
                break
        if count != self._fitting:
            if count < len(units):
                self._explain(
                    now,
                    f"{count} of {len(units)} units fit: up to {units[count].name} all pairs would need "
                    f"{format_duration(short / self.workers)}, {format_duration(left / self.workers)} are left",
                )
            elif self._fitting >= 0:
                self._explain(now, f"all {count} units fit again")
            self._fitting = count
        return count

    # The passes

    def _open_phase(self, now: float) -> bool:
        """Queue the next pass; false where it has to wait for jobs that are out, or there is none."""
        if self.phase is not Phase.SWEEP and (self._flying or self._again):
            return False  # who is weakest is known when all pairs are back
        opened = next(self._phases, None)
        if opened is None:
            return False
        self._queue.extend(opened(now))
        self._pairs_of_phase = self._pairs_queued = sum(len(stretch.indices) for stretch in self._queue)
        return True

    def _sweep(self, _: float) -> list[Stretch]:
        """The first unit on all pairs: an F for every pair, early."""
        first = tuple(unit for unit in self.recipe.regular if unit.stage == 1)
        return [Stretch(Phase.SWEEP, indices, first) for indices in chunks(self._order)]

    def _deepen(self, now: float) -> list[Stretch]:
        """The other units, chunk by chunk: as many as let all remaining pairs have them."""
        self.phase = Phase.DEEPEN
        self._explain(now, "the sweep is over; deepening begins")
        return [Stretch(Phase.DEEPEN, indices) for indices in chunks(self._order)]

    def _upgrade(self, now: float) -> list[Stretch]:
        """What was left out, the weakest pairs first, and for weak ones the extra units."""
        self.phase = Phase.UPGRADE
        extras = [unit for unit in self.recipe.units if unit.extra]
        touched = [record for record in self.records if record.units and record.index not in self._aside]
        # By what they had before they were upgraded, so that a run that goes on decides as it did before.
        touched.sort(key=lambda record: (inliers_before(record), record.index))
        weak = [
            one for one in touched if is_weak(one, self.recipe.upgrade) or len(one.lacking(extras)) < len(extras)
        ]
        chosen = {record.index for record in weak}
        others = [one for one in touched if one.index not in chosen and one.lacking(self.recipe.regular)]
        self._explain(now, f"upgrading begins: {len(weak)} weak pairs, {len(others)} others lack units")
        regular = self.recipe.regular
        return self._rounds.cut((one.index for one in weak), self.recipe.units) + [
            Stretch(Phase.UPGRADE, indices, regular) for indices in chunks(one.index for one in others)
        ]

    def _round_may_begin(self, stretch: Stretch, now: float) -> bool:
        """Whether the pairs that decide it are back; if they gained nothing, the extra units end."""
        judged = self._rounds.judged_before(stretch)
        if not judged:
            return True
        again = chain.from_iterable(one.indices for one in self._again)
        if not self._flying.isdisjoint(judged) or not set(judged).isdisjoint(again):
            return self._jobs_out < self.workers  # a worker that hangs does not keep the others waiting
        if reason := self._rounds.judge([self.records[index] for index in judged]):
            self._explain(now, reason)
            regular = self.recipe.regular
            self._queue = deque(replace(one, units=regular, round=0) for one in self._queue)
        return True

    # What came of it

    def take(self, finished: Finished, now: float) -> list[Outcome]:
        """Take note of a finished job; what it brought, to be kept."""
        plan = finished.job.plan
        measured = finished.measured()
        self._measure(plan, measured, now, len(finished.outcomes))
        self._back(plan)
        self._hung_in_a_row = 0
        if plan.exploring and now >= plan.deadline:
            for unit in plan.units:
                self.costs.suppose(unit.name, self._allowance)
        kept = [kept for outcome in finished.outcomes if (kept := self._merge(outcome, plan.phase, now))]
        self._go_on(plan, now)
        return kept

    def _go_on(self, plan: Plan, now: float) -> None:
        """What a job's own deadline cut off is planned anew."""
        cut = now + max(plan.expected) >= plan.deadline
        rest = tuple(index for index in plan.indices if self._can_gain(index, plan.units))
        if cut and rest and not plan.exploring and plan.deadline < self.budget.stop:
            self._again.append(Stretch(plan.phase, rest, plan.units, plan.shrink))

    def _measure(self, plan: Plan, measured: list[tuple[str, float]], now: float, pairs: int) -> None:
        if measured and plan.shrink == 1:
            for unit, seconds in measured:
                self.costs.observe(unit, seconds)
            elapsed = (now - self._last_event) * min(self.workers, self._jobs_out)
            self.costs.observe_overhead((elapsed - sum(seconds for _, seconds in measured)) / pairs)
        self._last_event = now

    def _merge(self, outcome: Outcome, phase: Phase, now: float) -> Outcome | None:
        """The outcome to keep, if the job brought anything: a unit more, or the reason why there can be none."""
        record, former = outcome.record, self.records[outcome.record.index]
        if not outcome.results and record.failure and record.reached:
            self._aside.add(record.index)
            if former.units:
                self._explain(now, f"pair {record.index} keeps the F it has: {record.failure}")
        if len(record.units) <= len(former.units) and (former.reached or not record.reached):
            return None
        self._losses.prove(result.unit for result in outcome.results)
        record = record.after(former, inliers_before(former) if phase is Phase.UPGRADE else former.before)
        self._put(record)
        return Outcome(record, outcome.results)

    def _put(self, record: Record) -> None:
        former = self.records[record.index]
        had = {unit.name for unit in former.lacking(self.recipe.regular)} if former.units else set()
        lacks = {unit.name for unit in record.lacking(self.recipe.regular)} if record.units else set()
        self._lacking.subtract(had - lacks)
        self._lacking.update(lacks - had)
        self.records[record.index] = record

    def _back(self, plan: Plan) -> None:
        self._flying.difference_update(plan.indices)
        self._jobs_out -= 1
        self._exploring -= plan.exploring

    def lose(self, lost: Lost, now: float) -> list[Outcome]:
        """Take note of a lost job, plan anew what may still come of it; what to keep."""
        self._back(lost.job.plan)
        self._hung_in_a_row += lost.cause is Cause.HUNG
        self._last_event = now
        verdict = self._losses.judge(lost, self.records, self.recipe.units)
        self._again.extend(verdict.again)
        for reason in verdict.reasons:
            self._explain(now, reason)
        if verdict.aside:
            self._set_aside(lost.job.plan.indices[0], lost)
        return [self._give_up(lost.job.plan.indices[0], verdict.given_up, lost)] if verdict.given_up else []

    def _set_aside(self, index: int, lost: Lost) -> None:
        """The pair keeps the F that it has, and gets nothing more in this run; a later one tries again."""
        self._aside.add(index)
        if not self.records[index].reached:
            self._put(Record.untouched(index, f"left alone: {lost}"))

    def _give_up(self, index: int, units: Sequence[Unit], lost: Lost) -> Outcome:
        """The pair keeps the F that it has; the units are marked as had, with the reason."""
        record, reason = self.records[index], f"given up: {lost}"
        empty = tuple(UnitRecord(unit.name, unit.stage, 0, 0, 0.0, 0.0, reason) for unit in units)
        failure = record.failure if record.reached else reason
        self._put(replace(record, units=record.units + empty, failure=failure))
        return Outcome(
            self.records[index], tuple(UnitResult(unit, Matches.empty(), failure=reason) for unit in units)
        )

    # What is left

    def wanted(self, record: Record) -> list[Unit]:
        """The units that a pair shall have if there is time: the extra ones only where it is weak."""
        extras = not self._rounds.over and is_weak(record, self.recipe.upgrade)
        return record.lacking(self._possible(self.recipe.units if extras else self.recipe.regular))

    @property
    def complete(self) -> bool:
        """Whether every pair has been reached and nothing is wanted for those that can be worked on."""
        return all(
            record.reached and not (record.units and record.index not in self._aside and self.wanted(record))
            for record in self.records
        )

    @property
    def progress(self) -> tuple[Phase, int, int]:
        """The present pass, how many of its pairs are behind, and how many there are."""
        ahead = self._pairs_queued + len(self._flying) + sum(len(stretch.indices) for stretch in self._again)
        return self.phase, max(0, self._pairs_of_phase - ahead), self._pairs_of_phase

    def _explain(self, now: float, text: str) -> None:
        self.explanations.append(Explanation(now - self.budget.started, text))
