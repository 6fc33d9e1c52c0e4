"""The planner: what to do next, and why; decisions on values, without threads or clocks.

It looks at a job's worth of pairs at a time, so that a hundred thousand pairs cost no more to plan than ten.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.chunk_queue import ChunkQueue
from mkpc_kaggle.engine.costs import Costs, Timeouts, needs
from mkpc_kaggle.engine.jobs import Cause, Chunk, Job, JobFailure, JobResult, Outcome, Phase, split
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.engine.retries import Retries
from mkpc_kaggle.engine.state import RunState
from mkpc_kaggle.engine.upgrade import UpgradeConfig, UpgradeRounds, is_weak
from mkpc_kaggle.recipe import Recipe, Unit

EXPLORE_SHARE = 0.25
"""The share of the time left that may be spent to learn what units cost that never ran."""
JOB_SHARE = 0.05
"""The share of the time left that a job may be expected to take: what a job found late comes too late."""
DEADLINE_SHARE = 0.5
"""The share of the time left after which a job begins no unit, so that a sudden slowdown is noticed."""
CONNECT_SHARE = 0.1
"""The share of the time left after the sweep that pairs may take which no row names."""
RESERVE_SHARE = 0.2
"""The share of the limit that is left to reconstruction at most."""
MOST_DOUBLINGS = 3
"""Of the silence that a job is allowed, while one job after the other hangs."""


@dataclass(frozen=True)
class Explanation:
    """A decision, and why; ``seconds`` since the run's start."""

    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


def pairs_that_fit(pairs: int, seconds: float, left: float) -> int:
    """How many pairs of ``seconds`` each a job may have, with ``left`` seconds to go; at least one."""
    return pairs if pairs * seconds <= JOB_SHARE * left else max(1, int(JOB_SHARE * left / seconds))


def units_that_fit(needed: Iterable[float], left: float) -> tuple[int, float]:
    """How many units all pairs can have in ``left`` seconds, and the seconds that one more would take.

    ``needed`` are the seconds for the first unit, the first two, and so on, see :func:`needs`.
    """
    count = 0
    for seconds in needed:
        if seconds > left:
            return count, seconds
        count += 1
    return count, 0.0


def sweep_chunks(order: Sequence[int], recipe: Recipe) -> list[Chunk]:
    """The first unit on all pairs: an F for every pair, early."""
    first = tuple(unit for unit in recipe.regular if unit.stage == 1)
    return [Chunk(Phase.SWEEP, indices, first) for indices in split(order)]


def weakest_first(records: Iterable[PairRecord], recipe: Recipe) -> tuple[list[int], list[int]]:
    """The pairs for the recipe's extra units, the weakest first, and the others that lack regular ones.

    Pairs are weak by what they had before they were upgraded, so that a run that goes on decides as it did before.
    """
    ranked = sorted(records, key=lambda record: (record.inliers_before, record.index))
    weak = [one for one in ranked if is_weak(one, UpgradeConfig())]
    chosen = {record.index for record in weak}
    others = [one.index for one in ranked if one.index not in chosen and one.lacking(recipe.regular)]
    return [one.index for one in weak], others


class Planner:
    """Sweep, deepen, upgrade, over the pairs of ``order``; after the sweep, that of the pairs of ``unasked``.

    ``records``, one a pair, by index, those of unasked pairs last, are in its ``state``, which jobs and scenes
    change through it. ``workers`` work at a time. ``deepened`` are the pairs that have all units that fit;
    ``reserve`` seconds of the end are left to others.
    """

    def __init__(
        self,
        order: Sequence[int],
        recipe: Recipe,
        records: list[PairRecord],
        budget: Budget,
        workers: int = 1,
        timeouts: Timeouts | None = None,
        unasked: Sequence[int] = (),
    ) -> None:
        self.recipe = recipe
        self.state = RunState(recipe, records, len(order))
        self.budget = budget
        self.workers = workers
        self.timeouts = timeouts or Timeouts()
        self.costs = Costs()
        self.explanations: list[Explanation] = []
        self._order = order
        self._unasked = unasked
        self._phases = iter((self._sweep, self._connect, self._deepen, self._upgrade))
        self._queue = ChunkQueue()
        self._rounds = UpgradeRounds(UpgradeConfig())
        self._retries = Retries()
        self.deepened = set(unasked)
        self.reserve = 0.0
        self._exploring = 0
        self._allowance = 0.0
        self._hung_in_a_row = 0
        self._last_event = budget.clock()
        self._fitting = -1

    @property
    def records(self) -> list[PairRecord]:
        return self.state.records

    # What to do next

    def next(self, now: float) -> Job | None:
        """The next job, without its pairs; ``None`` where there is nothing to do before another comes back."""
        if now >= self.stop:
            return None
        while (chunk := self._next_chunk(now)) is not None:
            units = self._units(chunk, now)
            todo = [index for index in chunk.indices if self.state.can_gain(index, units)]
            if chunk.phase is Phase.DEEPEN:
                self.deepened.update(set(chunk.indices) - set(todo))
            lacking = self.state.lacking_units(todo, units)
            unknown = not all(self.costs.known(unit.name) for unit in lacking)
            if unknown and (self._exploring >= self.workers or self._queue.jobs > self.workers):
                # What has no known cost cannot be planned: one try a worker, not long behind another job.
                self._queue.put_first(chunk)
                return None
            if todo:
                return self._job(chunk, todo, units, lacking, now, unknown=unknown)
        return None

    @property
    def stop(self) -> float:
        """When no unit may be running any more."""
        return self.budget.stop - min(self.reserve, RESERVE_SHARE * self.budget.limit)

    def _next_chunk(self, now: float) -> Chunk | None:
        if (chunk := self._queue.pop_retry()) is not None:
            return chunk
        while self._queue.is_empty:
            if not self._open_phase(now):
                return None
        first = self._queue.peek()
        if first is None or not self._round_may_begin(first, now):
            return None
        return self._queue.pop()

    def _job(
        self,
        chunk: Chunk,
        todo: list[int],
        units: tuple[Unit, ...],
        lacking: Sequence[Unit],
        now: float,
        *,
        unknown: bool,
    ) -> Job:
        """A job for the first of the pairs; the others go back to the front of the queue.

        It is one pair where some unit's cost is unknown and cannot be planned, and few where it gets late; in
        the end the first of its units, since what one job does comes back, or is lost, at once.
        """
        left = self.stop - now
        seconds = self.costs.overhead + sum(self.costs.of(unit.name) for unit in lacking)
        most = 1 if unknown else pairs_that_fit(len(todo), seconds, left)
        if todo[most:]:
            self._queue.put_first(replace(chunk, indices=tuple(todo[most:])))
        indices = tuple(todo[:most])
        if not unknown and len(lacking) > 1 and seconds > JOB_SHARE * left:
            first, *rest = sorted(lacking, key=lambda unit: unit.stage)
            self._queue.put_first(replace(chunk, indices=indices, units=tuple(rest)))
            units = lacking = (first,)
        self._queue.begin(indices)
        self._exploring += unknown
        self._allowance = EXPLORE_SHARE * left
        if self._queue.jobs == 1:
            self._last_event = now
        return Job(
            chunk.phase,
            indices,
            units,
            tuple(self.costs.most(unit.name) for unit in units),
            now + self._allowance if unknown else self._deadline(lacking, len(indices), now),
            self._timeout(lacking, len(indices), unknown=unknown),
            chunk.shrink,
            unknown,
        )

    def _timeout(self, lacking: Sequence[Unit], pairs: int, *, unknown: bool) -> float:
        """Twice as long after each job that hung with none ended since: it may be the machine that is slow."""
        allowance = self._allowance if unknown else None
        timeout = self.timeouts.of_job(lacking, pairs, self.costs, self.budget.limit, allowance)
        return timeout * (1 << min(self._hung_in_a_row, MOST_DOUBLINGS))

    def _deadline(self, lacking: Iterable[Unit], pairs: int, now: float) -> float:
        """Early enough to plan the rest anew, but late enough for twice what the job should take."""
        seconds = pairs * (self.costs.overhead + sum(self.costs.most(unit.name) for unit in lacking))
        return min(self.stop, now + max(DEADLINE_SHARE * (self.stop - now), 2 * seconds))

    def _units(self, chunk: Chunk, now: float) -> tuple[Unit, ...]:
        """The units for a chunk whose turn has come."""
        if chunk.units is None:
            regular = self._usable(self.recipe.regular)
            units = regular[: self._fit(regular, now)]
        else:
            units = self._usable(chunk.units)
        if chunk.phase is Phase.SWEEP:
            return units[:1]
        return tuple(unit for unit in units if self.costs.most(unit.name) < self.stop - now)

    def _usable(self, units: Iterable[Unit]) -> tuple[Unit, ...]:
        return tuple(unit for unit in units if unit.name not in self._retries.unusable)

    def _fit(self, units: tuple[Unit, ...], now: float) -> int:
        """How many units all pairs can have in the time left; a change is explained."""
        left = (self.stop - now) * self.workers
        count, short = units_that_fit(needs(units, self.state.lacking, self.costs), left)
        if count == self._fitting:
            return count
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

    # The phases

    def _open_phase(self, now: float) -> bool:
        """Begin the next phase; false where it has to wait for jobs under way, or there is none."""
        if self._queue.phase is Phase.DEEPEN and not self._queue.is_idle:
            return False  # which pairs are weakest is known when all are back
        opened = next(self._phases, None)
        if opened is None:
            return False
        self._queue.open(*opened(now))
        return True

    def _sweep(self, _: float) -> tuple[Phase, list[Chunk]]:
        return Phase.SWEEP, sweep_chunks(self._order, self.recipe)

    def _connect(self, now: float) -> tuple[Phase, list[Chunk]]:
        """The first unit on pairs that no row names, as many as a share of the time left allows."""
        first = self.recipe.regular[:1]
        left = CONNECT_SHARE * (self.stop - now) * self.workers
        seconds = self.costs.overhead + self.costs.of(first[0].name)
        count = len(self._unasked) if seconds * len(self._unasked) <= left else int(left / seconds)
        if self._unasked:
            self._explain(now, f"{count} of {len(self._unasked)} pairs are matched for the scenes' sake alone")
        return Phase.CONNECT, [Chunk(Phase.CONNECT, indices, first) for indices in split(self._unasked[:count])]

    def _deepen(self, now: float) -> tuple[Phase, list[Chunk]]:
        self._explain(now, "the sweep is over; deepening begins")
        return Phase.DEEPEN, [Chunk(Phase.DEEPEN, indices) for indices in split(self._order)]

    def _upgrade(self, now: float) -> tuple[Phase, list[Chunk]]:
        weak, others = weakest_first(self.state.workable, self.recipe)
        self._explain(now, f"upgrading begins: {len(weak)} weak pairs, {len(others)} others lack units")
        regular = [Chunk(Phase.UPGRADE, indices, self.recipe.regular) for indices in split(others)]
        return Phase.UPGRADE, self._rounds.split(weak, self.recipe.units) + regular

    def _round_may_begin(self, chunk: Chunk, now: float) -> bool:
        """Whether the pairs that decide it are back; if they gained nothing, the extra units end."""
        judged = self._rounds.judged_before(chunk)
        if not judged:
            return True
        if not self._queue.are_back(judged):
            return self._queue.jobs < self.workers  # a worker that hangs does not keep the others waiting
        if reason := self._rounds.judge([self.records[index] for index in judged]):
            self._explain(now, reason)
            self._queue.limit_units(self.recipe.regular)
        return True

    # What came of it

    def take(self, result: JobResult, now: float) -> list[Outcome]:
        """Take note of a finished job; what it brought, to be kept."""
        job = result.job
        self._measure(result, now)
        self._end(job)
        self._hung_in_a_row = 0
        if job.exploring and now >= job.deadline:
            for unit in job.units:
                self.costs.suppose(unit.name, self._allowance)
        if job.phase is Phase.DEEPEN:
            self.deepened.update(job.indices)
        kept = []
        for outcome in result.outcomes:
            if reason := self.state.stuck(outcome):
                self._explain(now, reason)
            if (changed := self.state.merge(outcome, job.phase)) is not None:
                kept.append(changed)
                self._retries.prove(one.unit for one in outcome.results)
        self._go_on(job, now)
        return kept

    def _go_on(self, job: Job, now: float) -> None:
        """What a job's own deadline cut off is planned anew."""
        cut = now + max(job.expected) >= job.deadline
        rest = tuple(index for index in job.indices if self.state.can_gain(index, job.units))
        if cut and rest and not job.exploring and job.deadline < self.stop:
            self._queue.retry([Chunk(job.phase, rest, job.units, job.shrink)])

    def _measure(self, result: JobResult, now: float) -> None:
        if result.results and result.job.shrink == 1:
            for one in result.results:
                self.costs.observe(one.unit.name, one.seconds, warm_up=one.warm_up)
            elapsed = (now - self._last_event) * min(self.workers, self._queue.jobs)
            self.costs.observe_overhead((elapsed - result.unit_seconds) / len(result.outcomes))
        self._last_event = now

    def _end(self, job: Job) -> None:
        self._queue.end(job.indices)
        self._exploring -= job.exploring

    def lose(self, failure: JobFailure, now: float) -> list[Outcome]:
        """Take note of a failed job, plan anew what may still come of it; what to keep."""
        job = failure.job
        self._end(job)
        self._hung_in_a_row += failure.cause is Cause.HUNG
        self._last_event = now
        retry = self._retries.after(failure, self.records, self.recipe.units)
        self._queue.retry(retry.chunks)
        if job.phase is Phase.DEEPEN and not retry.chunks:
            self.deepened.update(job.indices)
        for reason in retry.reasons:
            self._explain(now, reason)
        if retry.leave_pair:
            self.state.leave_alone(job.indices[0], failure)
        return [self.state.give_up(job.indices[0], retry.give_up, failure)] if retry.give_up else []

    # What is left

    def wanted(self, record: PairRecord) -> list[Unit]:
        """The units that a pair gets if there is time: the extra ones only where it is weak."""
        if record.index >= self.state.asked:
            return []
        extras = not self._rounds.over and is_weak(record, UpgradeConfig())
        return record.lacking(self._usable(self.recipe.units if extras else self.recipe.regular))

    def may_gain(self, record: PairRecord) -> bool:
        """Whether a pair has an F and can get units that it wants."""
        return bool(record.units and record.index not in self.state.left_alone and self.wanted(record))

    @property
    def complete(self) -> bool:
        """Whether every pair has been reached and nothing is wanted for those that can be worked on."""
        asked = self.records[: self.state.asked]
        return all(record.reached and not self.may_gain(record) for record in asked)

    @property
    def progress(self) -> tuple[Phase, int, int]:
        """The present phase, how many of its pairs are done, and how many it has."""
        return self._queue.progress

    def _explain(self, now: float, text: str) -> None:
        self.explanations.append(Explanation(now - self.budget.started, text))
