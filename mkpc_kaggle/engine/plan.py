"""The plan: which units to run on which pairs next, and why. Decisions on values, without threads or clocks.

It looks at a job's worth of pairs at a time, so that a hundred thousand pairs cost no more to plan than ten.

Three places decide that a unit no longer fits:

- :meth:`Plan._fit`, for all pairs: how many units they can have in the time left, each time a chunk is deepened;
- :meth:`Plan.next`, for a job: units that would not end in time wait for a moment when scenes need less;
- :meth:`mkpc_kaggle.engine.worker.MatchRunner.run`, in a worker: a job that is late begins no further unit.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import inf

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.costs import Costs
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, MatchResult, Outcome, Phase
from mkpc_kaggle.engine.records import GIVEN_UP, PairRecord, UnitRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit

JOB_PAIRS = 8  # in a job: few enough to plan anew every some seconds
JOB_MINIBATCHES = 3  # on a GPU: F of the pairs of the first is estimated while the others are matched
JOB_SHARE = 0.05  # of the time left that a job may be expected to take: what a job found late comes too late
EXPLORE_SHARE = 0.25  # of the time left that may be spent to learn what a unit costs that never ran
MAX_EXPLORE_S = 600.0
CONNECT_SHARE = 0.1  # of the time left after the sweep, for pairs that no row names
RESERVE_SHARE = 0.2  # of the limit that is left to reconstruction at most
MAX_TRIES = 2  # of a unit, or of an estimate, on a single pair, before it is given up there
MAX_FAILED_PAIRS = 2  # a unit that was given up on so many pairs and never ran is given up on all
SLOW_FACTOR = 3.0  # a job that takes this many times what was expected begins no further unit
HANG_FACTOR = 10.0  # a unit that takes this many times what it takes on nine of ten pairs hangs


@dataclass(frozen=True)
class Chunk:
    """Pairs that wait for their turn; ``units`` ``None``: those of the phase. ``lost_at`` names places."""

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...] | None = None
    lost_at: tuple[str, ...] = ()


def chunks_of(phase: Phase, indices: Sequence[int], size: int) -> Iterator[Chunk]:
    """The first pair alone, so that costs are known early, then ``size`` at a time.

    The same for every run of the same pairs, whatever was done before: a minibatch's composition can move the last
    bits of a network's output.
    """
    for start in (0, *range(1, len(indices), size)) if indices else ():
        yield Chunk(phase, tuple(indices[start : start + size if start else 1]))


class ChunkQueue:
    """Chunks in the order of their turn: first what was tried before.

    A pair's turn comes when no job is under way on it, and nothing earlier waits for it: what has to be tried
    again may be for another place, and the order of units decides regions.
    """

    def __init__(self) -> None:
        self.under_way: set[int] = set()
        self.fresh: deque[Chunk] = deque()
        self.again: list[Chunk] = []

    def put_back(self, *chunks: Chunk) -> None:
        """Put these first, but for what was lost: so a unit that kills its worker is given up on few pairs."""
        self.again = sorted([*chunks, *self.again], key=lambda chunk: not chunk.lost_at)

    def pop(self, place: str, *, alone: bool, cautious: bool) -> Chunk | None:
        """The next chunk for a place, lost elsewhere if at all, unless the place is ``alone``.

        ``cautious``: a chunk that was not lost, if there is any.
        """
        free, earlier = [], set(self.under_way)
        for chunk in (*self.again, *islice(self.fresh, 1)):
            if earlier.isdisjoint(chunk.indices) and (alone or place not in chunk.lost_at):
                free.append(chunk)
            earlier.update(chunk.indices)
        if not free:
            return None
        chosen = min(free, key=lambda chunk: bool(chunk.lost_at)) if cautious else free[0]
        if chosen in self.again:
            self.again.remove(chosen)
        else:
            self.fresh.popleft()
        return chosen

    def waits(self, index: int) -> bool:
        """Whether something has to be tried again on a pair."""
        return any(index in chunk.indices for chunk in self.again)


def job_size(pairs: int, prices: Sequence[float | None], overhead: float, seconds: float) -> tuple[int, int]:
    """How many of so many pairs, and of the units with these ``prices``, are in a job of some ``seconds``.

    A price is what a unit costs on a pair, ``None`` while that is unknown: then the job is one pair, and the units
    up to it. Late in the run: fewer pairs, then one unit, because a job's results arrive, or are lost, together.
    """
    if None in prices:
        pairs, prices = 1, prices[: prices.index(None) + 1]
    price = overhead + sum(filter(None, prices))
    if pairs * price <= seconds:
        return pairs, len(prices)
    return max(1, int(seconds / price)), len(prices) if price <= seconds else 1


def _priced(units: Iterable[Unit]) -> list[str]:
    """The names by which the cost of a job on a pair is known."""
    return [unit.name for unit in units] or [Phase.ESTIMATE]


class Plan:
    """The phases of a run over the pairs of ``order``.

    ``records``, of all pairs by index, change through it. Pairs from the index ``row_count`` on are extra pairs
    for scenes, the most useful first. ``workers`` work at a time; ``reserve`` seconds of the end are left to
    scenes. ``done`` are the pairs that have what fits for all; ``unusable`` names the units that no worker can
    run. ``outdated`` are the pairs whose F another estimation made.
    """

    def __init__(
        self,
        order: Sequence[int],
        row_count: int,
        recipe: Recipe,
        records: list[PairRecord],
        budget: Budget,
        explain: Callable[[str], None],
        minibatch: int = 1,
        outdated: Iterable[int] = (),
    ) -> None:
        self.recipe, self.records, self.budget, self._explain = recipe, records, budget, explain
        self.outdated, self.estimated_anew = set(outdated), 0
        self.workers = 1
        self.reserve = 0.0
        self._order, self._row_count, self._minibatch = order, row_count, minibatch
        self._stuck: set[int] = set()  # an image cannot be read, or what was found before
        self._lacking = Counter(unit for record in records for unit in self._lacks(record))
        self._begin()

    def _begin(self) -> None:
        """Everything is to come, and nothing is known of the devices."""
        self.costs = Costs()
        self.unusable: set[str] = set()
        self.done = set(range(self._row_count, len(self.records)))
        self.phase = Phase.ESTIMATE
        self._coming = list(Phase)
        self._queue = ChunkQueue()
        self._late, self._late_at = list[Chunk](), inf  # what does not end before this moment, unless it moves
        self._total, self._left = 0, set[int]()  # pairs of the present phase, and those whose turn is not over
        self._fitting = -1
        self._tries: Counter[tuple[int, str]] = Counter()
        self._failed_pairs: Counter[str] = Counter()

    # What to do next

    def next(self, now: float, place: str = "", *, cautious: bool = False) -> MatchJob | None:
        """The next job for an idle place, without its pairs; ``None`` where there is nothing to do now.

        ``cautious``: the place has just lost a worker, and tries one pair and one unit.
        """
        queue, job = self._queue, None
        if self.stop > self._late_at:
            queue.put_back(*self._late)
            self._late.clear()
        while self.advance(now) and job is None:
            chunk = queue.pop(place, alone=self.workers < 2, cautious=cautious)
            if chunk is None:
                break
            units = self._units(chunk, now)
            todo = self._wanting(chunk.phase, chunk.indices, units)
            self._mark_done(chunk.phase, set(chunk.indices) - set(todo))
            in_time = tuple(unit for unit in units if self.costs.p90(unit.name) < self.stop - now)
            if chosen := self._wanting(chunk.phase, todo, in_time):
                job = self._job(replace(chunk, indices=chosen), in_time, now, cautious=cautious)
            if late := tuple(index for index in todo if index not in chosen):
                self._late.append(replace(chunk, indices=late))
                self._late_at = self.stop
        return job

    @property
    def stop(self) -> float:
        """When no unit may be running any more."""
        return self.budget.stop_units - min(self.reserve, RESERVE_SHARE * self.budget.time_limit)

    def advance(self, now: float) -> bool:
        """Go on to the first pairs that can gain something, past others and past phases; whether there are any."""
        queue = self._queue
        while now < self.stop and (queue.fresh or self._coming):
            if queue.fresh:
                chunk = queue.fresh[0]
                if self._wanting(chunk.phase, chunk.indices, self._units(chunk, now)):
                    break
                self._mark_done(chunk.phase, queue.fresh.popleft().indices)
            elif self.phase is Phase.ESTIMATE and (queue.under_way or queue.again):
                break  # scenes, which come later, need F of all pairs
            else:
                self._open(self._coming.pop(0), now)
        return now < self.stop and bool(queue.fresh or queue.again)

    def _wanting(self, phase: Phase, indices: Iterable[int], units: Sequence[Unit]) -> tuple[int, ...]:
        """The pairs that may get what a phase gives: another F, or any of the units."""
        if phase is Phase.ESTIMATE:
            return tuple(index for index in indices if index in self.outdated)
        return tuple(i for i in indices if i not in self._stuck and self.records[i].lacking(units))

    def _job(self, chunk: Chunk, units: tuple[Unit, ...], now: float, *, cautious: bool) -> MatchJob:
        """A job for the first of the pairs and units; the others go back to the front of the queue."""
        left, costs = self.stop - now, self.costs
        pair_count = unit_count = 1
        if not cautious:
            names = _priced(self._lacking_units(chunk.indices, units))
            prices = [costs.mean(name) if costs.is_known(name) else None for name in names]
            pair_count, unit_count = job_size(len(chunk.indices), prices, costs.overhead, JOB_SHARE * left)
        indices, later = chunk.indices[:pair_count], chunk.indices[pair_count:]
        lacking = self._lacking_units(indices, units)
        chosen, further = lacking[:unit_count], lacking[unit_count:]
        if later:
            self._queue.put_back(replace(chunk, indices=later))
        if further:
            self._queue.put_back(replace(chunk, indices=indices, units=further))
        self._queue.under_way.update(indices)
        p90 = tuple(costs.p90(unit.name) for unit in chosen)
        limits = self._limits(len(indices), chosen, left)
        return MatchJob(chunk.phase, indices, chosen, p90, *limits, is_retry=bool(chunk.lost_at))

    def _lacking_units(self, indices: Iterable[int], units: Sequence[Unit]) -> tuple[Unit, ...]:
        """Those of ``units`` that any of the pairs lacks, in the order in which they run."""
        lacking = dict.fromkeys(unit for index in indices for unit in self.records[index].lacking(units))
        return tuple(sorted(lacking, key=lambda unit: unit.stage))

    def _limits(self, pair_count: int, units: Sequence[Unit], left: float) -> tuple[float, float]:
        """The seconds within which units of a job may begin, and after which its worker hangs."""
        costs, minibatch = self.costs, min(pair_count, self._minibatch)
        names = _priced(units)
        expected = pair_count * (costs.overhead + sum(map(costs.p90, names)))
        allowance = SLOW_FACTOR * expected + self.budget.silence
        hangs = max(costs.hang_after(name, HANG_FACTOR * minibatch) for name in names)
        if not all(map(costs.is_known, names)):
            hangs += min(MAX_EXPLORE_S, EXPLORE_SHARE * left)
        return min(left, allowance), allowance + hangs

    def _units(self, chunk: Chunk, now: float) -> tuple[Unit, ...]:
        if chunk.units is not None:
            return self.usable(chunk.units)
        if chunk.phase is Phase.ESTIMATE:
            return ()
        units = self.usable(self.recipe.units)
        if chunk.phase is Phase.DEEPEN:
            return units[: self._fit(units, now)]
        return units if chunk.phase is Phase.FILL else self._first

    def usable(self, units: Iterable[Unit]) -> tuple[Unit, ...]:
        return tuple(unit for unit in units if unit.name not in self.unusable)

    @property
    def _first(self) -> tuple[Unit, ...]:
        """The unit that sweeps all pairs; none where none can run."""
        return self.usable(unit for unit in self.recipe.units if unit.stage == 1)[:1]

    def _fit(self, units: tuple[Unit, ...], now: float) -> int:
        """How many units all pairs can have in the time left; a change is explained."""
        left = (self.stop - now) * self.workers
        needed = list(self.costs.cumulative(units, self._lacking))
        count = next((number for number, seconds in enumerate(needed) if seconds > left), len(units))
        if count < len(units) and not self.costs.is_sure(units[count].name):
            return count + 1
        if count != self._fitting and count < len(units):
            self._explain(
                f"{count} of {len(units)} units fit: up to {units[count].name} all pairs would need "
                f"{format_duration(needed[count] / self.workers)} of {format_duration(left / self.workers)}",
            )
        elif count != self._fitting and self._fitting >= 0:
            self._explain(f"all {count} units fit again")
        self._fitting = count
        return count

    def _open(self, phase: Phase, now: float) -> None:
        self.phase, indices = phase, [index for index in self._order if index < self._row_count]
        if phase is Phase.ESTIMATE:
            indices = [index for index in self._order if index in self.outdated]
            if indices:
                self._explain(f"{len(indices)} pairs have the F of other settings, and get it anew")
        elif phase is Phase.CONNECT:
            extra, left = len(self.records) - self._row_count, CONNECT_SHARE * (self.stop - now) * self.workers
            seconds = self.costs.overhead + sum(self.costs.forecast(unit.name) for unit in self._first)
            count = extra if seconds * extra <= left else int(left / seconds)
            indices = [index for index in self._order if self._row_count <= index < self._row_count + count]
            if extra:
                self._explain(f"{count} of {extra} pairs are matched for the scenes alone")
        elif phase is Phase.DEEPEN:
            self._explain("the sweep is over; deepening begins")
        elif phase is Phase.FILL:
            busy = self._queue.under_way | {index for chunk in self._queue.again for index in chunk.indices}
            indices = sorted(self._fillable(), key=lambda i: (i in busy, self.records[i].inliers, i))
            if indices:
                self._explain(f"in the time left: {len(indices)} pairs that lack units, the weakest first")
        self._total, self._left = len(indices), set(indices)
        size = max(JOB_PAIRS, JOB_MINIBATCHES * self._minibatch if self._minibatch > 1 else 0)
        self._queue.fresh.extend(chunks_of(phase, indices, size))

    # What came of it

    def on_result(self, job: MatchJob, result: MatchResult, seconds: float) -> list[Outcome]:
        """Record a job that took so many seconds; what it brought, to be kept."""
        self._queue.under_way.difference_update(job.indices)
        for found in result.results:
            self.costs.observe(found.unit.name, found.seconds, warm_up=found.warm_up)
        if result.results:
            self.costs.observe_overhead((seconds - result.unit_seconds) / len(result.outcomes))
        if not job.units:
            self.costs.observe(Phase.ESTIMATE, seconds / len(job.indices))
        merge = self._merge if job.units else self._merge_estimate
        kept = [merged for outcome in result.outcomes if (merged := merge(outcome)) is not None]
        if rest := self._wanting(job.phase, job.indices, job.units):  # the job's own deadline cut it off
            self._queue.put_back(Chunk(job.phase, rest, job.units))
        self._mark_done(job.phase, set(job.indices) - set(rest))
        return kept

    def on_failure(self, job: MatchJob, failure: Failure, place: str) -> list[Outcome]:
        """Record a job that came to nothing, and plan it anew: halved, then unit by unit; what to keep.

        A unit that a single pair cannot have after two tries, in two places where there are two, is given up for
        that pair.
        """
        self._queue.under_way.difference_update(job.indices)
        chunk, half = Chunk(job.phase, job.indices, job.units, (place,)), len(job.indices) // 2
        if half:
            halves = job.indices[:half], job.indices[half:]
            self._queue.put_back(*(replace(chunk, indices=part) for part in halves))
            return []
        (index,) = job.indices
        units = self.records[index].lacking(job.units)
        if len(units) > 1:
            self._queue.put_back(*(replace(chunk, units=(unit,)) for unit in units))
            return []
        (name,) = _priced(units)
        if failure.cause is Cause.TIMED_OUT:
            self.costs.assume(name, job.time_limit)
        self._tries[index, name] += 1
        if self._tries[index, name] < MAX_TRIES:
            self._queue.put_back(chunk)
            return []
        self._mark_done(job.phase, [index])
        if units:
            return [self._give_up(index, units[0], failure)]
        self._explain(f"pair {index} keeps the F it has: {failure}")
        self.outdated.discard(index)
        return []

    def restart(self) -> list[Outcome]:
        """Begin anew on other devices: no unit is given up, and pairs keep what they have; what has changed."""
        whole = [record.without_given_up() for record in self.records]
        changed = [record for record in whole if record is not self.records[record.index]]
        self._begin()
        return list(map(self._put, changed))

    def _merge(self, outcome: Outcome) -> Outcome | None:
        """What a job has brought a pair, if anything: a unit more, or the reason why there can be none."""
        record, former = outcome.record, self.records[outcome.record.index]
        if not outcome.results and record.failure and record.reached:
            self._stuck.add(record.index)  # an image cannot be read
            if former.units:
                self._explain(f"pair {record.index} keeps the F it has: {record.failure}")
        if len(record.units) <= len(former.units) and (former.reached or not record.reached):
            if outcome.results:  # what was found before cannot be read, and a worse F gains nothing
                self._stuck.add(record.index)
            return None
        return self._put(record.after(former), outcome.results)

    def _merge_estimate(self, outcome: Outcome) -> Outcome | None:
        """The F that a job without units has made of all that was found on a pair."""
        record, former = outcome.record, self.records[outcome.record.index]
        self.outdated.discard(record.index)
        if len(record.units) < len(former.units):
            self._explain(f"pair {record.index} keeps the F it has: its points cannot be read")
            return None
        self.estimated_anew += 1
        return self._put(record.after(former))

    def _give_up(self, index: int, unit: Unit, failure: Failure) -> Outcome:
        """The pair keeps the F that it has; the unit is marked as had, with the reason."""
        record, nothing = self.records[index], UnitResult(unit, Matches.empty(), failure=f"{GIVEN_UP}{failure}")
        self._explain(f"{unit.name} is given up on pair {index} ({failure})")
        self._failed_pairs[unit.name] += 1
        if self._failed_pairs[unit.name] >= MAX_FAILED_PAIRS and not self.costs.has_run(unit.name):
            self.unusable.add(unit.name)
            self._explain(f"{unit.name} is given up on all pairs: it never ran ({failure})")
        units = (*record.units, UnitRecord.of(nothing, 0))
        message = record.failure if record.reached else nothing.failure
        return self._put(replace(record, units=units, failure=message), (nothing,))

    def _mark_done(self, phase: Phase, indices: Iterable[int]) -> None:
        """The turn of these pairs is over in a phase, unless they are to be tried again."""
        over = {index for index in indices if not self._queue.waits(index)}
        if phase is self.phase:
            self._left -= over
        if phase not in (Phase.ESTIMATE, Phase.SWEEP, Phase.CONNECT):
            self.done |= over

    # What is left

    @property
    def filling(self) -> Collection[int]:
        """Pairs that get more than what fits for all, in the time left."""
        return self._left if self.phase is Phase.FILL else ()

    def _fillable(self) -> tuple[int, ...]:
        """The pairs of rows that have a unit and can get further units."""
        matched = (index for index in range(self._row_count) if self.records[index].units)
        return self._wanting(Phase.FILL, matched, self.usable(self.recipe.units))

    @property
    def is_complete(self) -> bool:
        """Whether every pair has been reached, and none can gain what it wants, nor another F."""
        are_reached = all(record.reached for record in self.records[: self._row_count])
        return are_reached and not self.outdated and not self._fillable()

    @property
    def nothing_runs(self) -> bool:
        return not self.usable(self.recipe.units)

    @property
    def progress(self) -> tuple[Phase, int, int]:
        """The present phase, how many of its pairs are done, and how many it has."""
        return self.phase, self._total - len(self._left), self._total

    def _put(self, record: PairRecord, results: tuple[UnitResult, ...] = ()) -> Outcome:
        """Replace a pair's record; what is to be kept of that."""
        self._lacking.subtract(self._lacks(self.records[record.index]))
        self._lacking.update(self._lacks(record))
        self.records[record.index] = record
        return Outcome(record, results)

    def _lacks(self, record: PairRecord) -> list[str]:
        """The units that a pair is to get yet, if it has an F and a row."""
        has_row = record.index < self._row_count
        return [unit.name for unit in record.lacking(self.recipe.units)] if record.units and has_row else []
