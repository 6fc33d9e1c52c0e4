"""The plan: which units to run on which pairs next, and why. Decisions on values, without threads or clocks.

It looks at a job's worth of pairs at a time, so that a hundred thousand pairs cost no more to plan than ten.
"""

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

from mkpc_kaggle.engine.budget import Budget, format_duration
from mkpc_kaggle.engine.costs import Costs
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, MatchResult, Outcome, Phase
from mkpc_kaggle.engine.records import GIVEN_UP, PairRecord, UnitRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.choose import Choice

JOB_PAIRS = 8  # in a job: few enough to plan anew every some seconds
JOB_MINIBATCHES = 3  # on a GPU: F of the pairs of the first is estimated while the others are matched
JOB_SHARE = 0.05  # of the time left that a job may be expected to take: what a job found late comes too late
EXPLORE_SHARE = 0.25  # of the time left that may be spent to learn what a unit costs that never ran
MAX_EXPLORE_S = 600.0
CONNECT_SHARE = 0.1  # of the time left after the sweep, for pairs that no row names
DENSIFY_SHARE = 0.5  # of the time left when all units have run, for further such pairs; the rest is for scenes
RESERVE_SHARE = 0.2  # of the limit that is left to reconstruction at most
MAX_TRIES = 2  # of a unit on a single pair, before it is given up there
MAX_FAILED_PAIRS = 2  # a unit that was given up on so many pairs and never ran is given up on all
SLOW = 3.0  # a job that takes this many times what was expected begins no further unit
HANGS = 10.0  # a unit that takes this many times what it takes on nine of ten pairs hangs
MAX_SILENCE_S, MIN_SILENCE_S, SILENCE_SHARE = 60.0, 5.0, 0.02  # besides, by the share of the limit


@dataclass(frozen=True)
class Explanation:
    """A decision, and why; ``seconds`` since the run's start."""

    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


@dataclass(frozen=True)
class Chunk:
    """Pairs that wait for their turn; ``units`` ``None``: as many as fit then. ``lost_at`` names places."""

    phase: Phase
    indices: tuple[int, ...]
    units: tuple[Unit, ...] | None = None
    lost_at: tuple[str, ...] = ()


def chunks_of(phase: Phase, indices: Iterable[int], size: int, units: tuple[Unit, ...] | None) -> Iterator[Chunk]:
    """One pair alone, so that costs are known early, then ``size`` at a time.

    The same for every run of the same pairs, whatever was done before: a minibatch's composition can move the last
    bits of a network's output.
    """
    indices = tuple(indices)
    for start in (0, *range(1, len(indices), size)) if indices else ():
        yield Chunk(phase, indices[start : start + size if start else 1], units)


class ChunkQueue:
    """Chunks in the order of their turn. A pair's turn comes when no job is under way on it, nor waits to be
    tried again: that may be for another place.
    """

    def __init__(self) -> None:
        self.under_way: set[int] = set()
        self._waiting: deque[Chunk] = deque()
        self._retries: deque[Chunk] = deque()

    def extend(self, chunks: Iterable[Chunk]) -> None:
        self._waiting.extend(chunks)

    def put_first(self, chunk: Chunk) -> None:
        """Give a chunk back, or what is left of it; its turn is after those that were lost."""
        place = 0 if chunk.lost_at else sum(bool(waiting.lost_at) for waiting in self._retries)
        self._retries.insert(place, chunk)

    def retry(self, chunks: Iterable[Chunk]) -> None:
        """Try these again, before all others: so a unit that kills its worker is given up on few pairs."""
        self._retries.extendleft(reversed(list(chunks)))

    def pop(self, place: str, *, alone: bool, cautious: bool) -> Chunk | None:
        """The next chunk for a place; not one that was lost there, unless the place is ``alone``.

        ``cautious``: one that was not lost, if there is one.
        """
        chunk = (self._pop_fresh() if cautious else None) or self._pop_retry(place, alone, cautious)
        return chunk or self._pop_fresh()

    def _pop_fresh(self) -> Chunk | None:
        if self._waiting and not any(map(self.is_busy, self._waiting[0].indices)):
            return self._waiting.popleft()
        return None

    def _pop_retry(self, place: str, alone: bool, cautious: bool) -> Chunk | None:
        for chunk in reversed(self._retries) if cautious else self._retries:
            if self.under_way.isdisjoint(chunk.indices) and (alone or place not in chunk.lost_at):
                self._retries.remove(chunk)
                return chunk
        return None

    def is_busy(self, index: int) -> bool:
        """Whether a job is under way on a pair, or has to be tried again."""
        return index in self.under_way or self.has_retry(index)

    def has_retry(self, index: int) -> bool:
        """Whether something has to be tried again on a pair."""
        return any(index in chunk.indices for chunk in self._retries)

    def drop(self) -> None:
        """Take out the first chunk."""
        self._waiting.popleft()

    @property
    def first(self) -> Chunk | None:
        """The next chunk that has not been tried yet."""
        return self._waiting[0] if self._waiting else None

    @property
    def has_retries(self) -> bool:
        return bool(self._retries)


class Plan:
    """The phases of a run over the pairs of ``order`` and, for the scenes alone, of ``extra``, which no row names.

    ``records``, one a pair by index, asked pairs first, change through it. The first ``connecting`` of the extra
    pairs are for the connect phase. ``workers`` work at a time; ``reserve`` seconds of the end are left to scenes.
    ``done`` are the pairs that have what fits for all, and ``filling`` those that get more in the time left;
    ``unusable`` names the units that no worker can run.
    """

    def __init__(
        self,
        order: Sequence[int],
        recipe: Recipe,
        records: list[PairRecord],
        budget: Budget,
        *,
        extra: Sequence[int] = (),
        connecting: int = 0,
        minibatch: int = 1,
    ) -> None:
        self.recipe = recipe
        self.records = records
        self.budget = budget
        self.minibatch = minibatch
        self.workers = 1
        self.reserve = 0.0
        self.costs = Costs()
        self.explanations: list[Explanation] = []
        self.unusable: set[str] = set()
        self.phase = Phase.SWEEP
        self._order, self._extra, self._connecting = order, extra, connecting
        self._stuck: set[int] = set()
        self._proven: set[str] = set()
        self._tries: Counter[tuple[int, str]] = Counter()
        self._failed_pairs: dict[str, set[int]] = {}
        self._fitting = -1
        self._lacking = Counter(unit for record in records for unit in self._lacks(record))
        self._reached = sum(record.reached for record in records[: len(order)])
        self._matched = sum(record.reached for record in records[len(order) :])
        self._total = 0
        self._begin()

    # What to do next

    def next(self, now: float, place: str = "", *, cautious: bool = False) -> MatchJob | None:
        """The next job for an idle place, without its pairs; ``None`` where there is nothing to do now.

        ``cautious``: the place has just lost a worker, and tries one pair and one unit.
        """
        if cautious and (trial := self._trial(now)) is not None:
            return trial
        while now < self.stop and (chunk := self._pop(place, now, cautious=cautious)) is not None:
            units = self._units(chunk, now)
            todo = [index for index in chunk.indices if self.can_gain(index, units)]
            self._mark_done(chunk.phase, set(chunk.indices) - set(todo))
            in_time = tuple(unit for unit in units if self.costs.p90(unit.name) < self.stop - now)
            if todo and not in_time:  # unless scenes need less time than is kept for them
                self._queue.put_first(replace(chunk, indices=tuple(todo)))
                return None
            if todo := [index for index in todo if self.can_gain(index, in_time)]:
                return self._job(chunk, todo, in_time, now, cautious=cautious)
        return None

    @property
    def stop(self) -> float:
        """When no unit may be running any more."""
        return self.budget.stop_units - min(self.reserve, RESERVE_SHARE * self.budget.time_limit)

    def has_work(self, now: float) -> bool:
        """Whether a pair waits that can gain something; what is under way may come back, too."""
        while (chunk := self._peek(now)) is not None:
            if any(self.can_gain(index, self._units(chunk, now)) for index in chunk.indices):
                return True
            self._queue.drop()
            self._mark_done(chunk.phase, chunk.indices)
        return self._queue.has_retries

    def can_gain(self, index: int, units: Iterable[Unit]) -> bool:
        """Whether a pair may have one of the units that it has not had."""
        return index not in self._stuck and bool(self.records[index].lacking(units))

    def _begin(self) -> None:
        self._queue = ChunkQueue()
        self.done, self.filling = set(self._extra), set[int]()
        self._coming = list(Phase)

    def _trial(self, now: float) -> MatchJob | None:
        """The first unit on a pair that has had it, where nothing is left but what workers were lost at.

        A place that answers works: it is not closed for the pairs that kill every worker.
        """
        if self._peek(now) is not None or not self._queue.has_retries or now >= self.stop:
            return None
        for unit, record in product(self._first, self.records):
            ran = any(found.unit == unit.name and not found.failure for found in record.units)
            if ran and not self._queue.is_busy(record.index):
                self._queue.under_way.add(record.index)
                times = self._time([unit], 1, self.stop - now, exploring=False)
                expected = (self.costs.p90(unit.name),)
                return MatchJob(self.phase, (record.index,), (unit,), expected, *times, is_trial=True)
        return None

    def _peek(self, now: float) -> Chunk | None:
        """The next chunk of the present phase, or of those to come."""
        while self._queue.first is None and self._coming:
            self._open(self._coming.pop(0), now)
        return self._queue.first

    def _pop(self, place: str, now: float, *, cautious: bool) -> Chunk | None:
        self._peek(now)
        return self._queue.pop(place, alone=self.workers < 2, cautious=cautious)

    def _job(
        self, chunk: Chunk, todo: list[int], units: tuple[Unit, ...], now: float, *, cautious: bool
    ) -> MatchJob:
        """A job for the first of the pairs and units; the others go back to the front of the queue.

        It is one pair and one unit more where a unit's cost is unknown and cannot be planned, few pairs where it
        gets late, and in the end one unit, since what one job does comes back, or is lost, at once.
        """
        left = self.stop - now
        lacking = sorted(self._lacking_units(todo, units), key=lambda unit: unit.stage)
        unknown = [number for number, unit in enumerate(lacking) if not self.costs.is_known(unit.name)]
        seconds = self.costs.overhead + sum(self.costs.mean(unit.name) for unit in lacking)
        pair_count = len(todo) if len(todo) * seconds <= JOB_SHARE * left else int(JOB_SHARE * left / seconds)
        unit_count = len(lacking) if seconds <= JOB_SHARE * left else 1
        if unknown:
            pair_count, unit_count = 1, min(unit_count, unknown[0] + 1)
        if cautious:
            pair_count = unit_count = 1
        indices = tuple(todo[: max(1, pair_count)])
        if len(indices) < len(todo):
            self._queue.put_first(replace(chunk, indices=tuple(todo[len(indices) :])))
        if unit_count < len(lacking):
            self._queue.put_first(replace(chunk, indices=indices, units=tuple(lacking[unit_count:])))
        self._queue.under_way.update(indices)
        chosen = lacking[:unit_count]
        exploring = any(not self.costs.is_known(unit.name) for unit in chosen)
        allowance, time_limit = self._time(chosen, len(indices), left, exploring=exploring)
        expected = tuple(self.costs.p90(unit.name) for unit in chosen)
        return MatchJob(chunk.phase, indices, tuple(chosen), expected, allowance, time_limit, exploring)

    def _time(self, units: Sequence[Unit], pairs: int, left: float, *, exploring: bool) -> tuple[float, float]:
        """The seconds in which a job may begin units, and those after which its worker hangs."""
        silence = min(MAX_SILENCE_S, max(MIN_SILENCE_S, SILENCE_SHARE * self.budget.time_limit))
        expected = pairs * (self.costs.overhead + sum(self.costs.p90(unit.name) for unit in units))
        longest = max(self.costs.longest(unit.name, HANGS * min(pairs, self.minibatch)) for unit in units)
        allowance = SLOW * expected + silence
        if exploring:
            longest += min(MAX_EXPLORE_S, EXPLORE_SHARE * left)
        return min(left, allowance), allowance + longest

    def _units(self, chunk: Chunk, now: float) -> tuple[Unit, ...]:
        """The units for a chunk whose turn has come."""
        if chunk.units is None:
            usable = self.usable(self.recipe.units)
            units = usable[: self._fit(usable, now)]
        else:
            units = self.usable(chunk.units)
        return units if chunk.phase in (Phase.DEEPEN, Phase.FILL) else units[:1]

    def usable(self, units: Iterable[Unit]) -> tuple[Unit, ...]:
        """The units but those that were given up on all pairs."""
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
        if count != self._fitting and count < len(units):
            self.explain(
                now,
                f"{count} of {len(units)} units fit: up to {units[count].name} all pairs would need "
                f"{format_duration(needed[count] / self.workers)} of {format_duration(left / self.workers)}",
            )
        elif count != self._fitting and self._fitting >= 0:
            self.explain(now, f"all {count} units fit again")
        self._fitting = count
        return count

    def _open(self, phase: Phase, now: float) -> None:
        """Begin a phase."""
        first = tuple(unit for unit in self.recipe.units if unit.stage == 1)
        size = max(JOB_PAIRS, JOB_MINIBATCHES * self.minibatch if self.minibatch > 1 else 0)
        self.phase = phase
        if phase is Phase.SWEEP:
            self._queue.extend(chunks_of(phase, self._order, size, first))
        elif phase is Phase.CONNECT and self._connecting:
            count = self._total = self._pairs_that_fit(CONNECT_SHARE, self._connecting, now)
            self.explain(now, f"{count} of {self._connecting} pairs are matched for the scenes alone")
            self._queue.extend(chunks_of(phase, self._extra[:count], size, first))
        elif phase is Phase.DEEPEN:
            self.explain(now, "the sweep is over; deepening begins")
            self._queue.extend(chunks_of(phase, self._order, size, None))
        elif phase is Phase.FILL:
            lacking = filter(self.may_gain, self.records[: len(self._order)])
            idle = (record for record in lacking if not self._queue.is_busy(record.index))
            weak = sorted(idle, key=lambda record: (record.inliers, record.index))
            self._add(phase, [record.index for record in weak], size, self.recipe.units, now)
        elif phase is Phase.DENSIFY:
            further = [index for index in self._extra if self.can_gain(index, self._first)]
            further = further[: self._pairs_that_fit(DENSIFY_SHARE, len(further), now)]
            self._add(phase, further, size, first, now)

    def _add(self, phase: Phase, indices: list[int], size: int, units: tuple[Unit, ...], now: float) -> None:
        """Give pairs that were done more units in the time that is left."""
        self._total, self.filling = len(indices), set(indices)
        if indices:
            what = (
                "pairs that lack units, the weakest first" if phase is Phase.FILL else "pairs for the scenes alone"
            )
            self.explain(now, f"in the time left: {len(indices)} {what}")
            self._queue.extend(chunks_of(phase, indices, size, units))

    def _pairs_that_fit(self, share: float, count: int, now: float) -> int:
        """How many of so many pairs can have the first unit in a share of the time left."""
        seconds = self.costs.overhead + sum(self.costs.forecast(unit.name) for unit in self._first)
        left = share * max(0.0, self.stop - now) * self.workers
        return count if seconds * count <= left else int(left / seconds)

    # What came of it

    def on_result(self, job: MatchJob, result: MatchResult, seconds: float, now: float) -> list[Outcome]:
        """Record a job that took so many seconds; what it brought, to be kept."""
        self._queue.under_way.difference_update(job.indices)
        for found in result.results:
            self.costs.observe(found.unit.name, found.seconds, warm_up=found.warm_up)
        if result.results:
            self.costs.observe_overhead((seconds - result.unit_seconds) / len(result.outcomes))
        kept = [changed for outcome in result.outcomes if (changed := self._merge(outcome, now)) is not None]
        ran = {outcome.record.index for outcome in result.outcomes if outcome.results}
        for index in ran - {outcome.record.index for outcome in kept}:
            if self.can_gain(index, job.units):
                self._stuck.add(index)
                self.explain(now, f"pair {index} keeps the F it has: what earlier jobs found cannot be read")
        rest = tuple(index for index in job.indices if self.can_gain(index, job.units))
        if rest:  # the job's own deadline cut it off
            self._queue.retry([Chunk(job.phase, rest, job.units)])
        self._mark_done(job.phase, set(job.indices) - set(rest))
        return kept

    def on_failure(self, job: MatchJob, failure: Failure, place: str, now: float) -> list[Outcome]:
        """Record a job that came to nothing, and plan it anew: halved, then unit by unit; what to keep.

        A unit that a single pair cannot have after two tries, in two places where there are two, is given up for
        that pair.
        """
        self._queue.under_way.difference_update(job.indices)
        if job.is_trial:
            return []
        chunk = Chunk(job.phase, job.indices, job.units, (place,))
        if len(job.indices) > 1:
            half = len(job.indices) // 2
            self._queue.retry(replace(chunk, indices=part) for part in (job.indices[:half], job.indices[half:]))
            return []
        (index,) = job.indices
        lacking = self.records[index].lacking(job.units)
        if len(lacking) > 1:
            self._queue.retry(replace(chunk, units=(unit,)) for unit in lacking)
            return []
        (unit,) = lacking
        if job.exploring and failure.cause is Cause.TIMED_OUT:
            self.costs.assume(unit.name, job.time_limit)
        self._tries[index, unit.name] += 1
        if self._tries[index, unit.name] < MAX_TRIES:
            self._queue.retry([chunk])
            return []
        outcome = self._give_up(index, unit, failure, now)
        self._mark_done(job.phase, [index])
        return [outcome]

    def set_scene(self, index: int, choice: Choice) -> None:
        """Record which F the reconstruction of its batch gives a pair."""
        self.records[index] = replace(self.records[index], scene=choice)

    def restart(self, now: float, reason: str) -> dict[int, int]:
        """Begin anew on other devices: costs are unknown, and no unit is given up. Pairs keep what they have.

        Returns by pair how many units it has got more: it is less where some had been given up.
        """
        self.explain(now, reason)
        self.costs, self.unusable, self._fitting = Costs(), set(), -1
        self._proven, self._tries, self._failed_pairs = set(), Counter(), {}
        changes = {}
        for record in self.records:
            whole = record.without_given_up()
            if whole is not record:
                self._put(whole)
                changes[record.index] = len(whole.units) - len(record.units)
        self._begin()
        return changes

    def _merge(self, outcome: Outcome, now: float) -> Outcome | None:
        """The outcome to keep, if the job brought anything: a unit more, or the reason why there can be none."""
        record, former = outcome.record, self.records[outcome.record.index]
        if not outcome.results and record.failure and record.reached:
            self._stuck.add(record.index)  # an image cannot be read
            if former.units:
                self.explain(now, f"pair {record.index} keeps the F it has: {record.failure}")
        if len(record.units) <= len(former.units) and (former.reached or not record.reached):
            return None
        record = record.after(former)
        self._put(record)
        self._proven.update(found.unit.name for found in outcome.results)
        return Outcome(record, outcome.results)

    def _give_up(self, index: int, unit: Unit, failure: Failure, now: float) -> Outcome:
        """The pair keeps the F that it has; the unit is marked as had, with the reason."""
        record, reason = self.records[index], f"{GIVEN_UP}{failure}"
        self.explain(now, f"{unit.name} is given up on pair {index} ({failure})")
        empty = UnitRecord(unit.name, unit.stage, 0, 0, 0.0, 0.0, reason)
        message = record.failure if record.reached else reason
        self._put(replace(record, units=(*record.units, empty), failure=message))
        failed = self._failed_pairs.setdefault(unit.name, set())
        failed.add(index)
        if len(failed) >= MAX_FAILED_PAIRS and unit.name not in self._proven:
            self.unusable.add(unit.name)
            self.explain(now, f"{unit.name} is given up on all pairs: it never ran ({failure})")
        return Outcome(self.records[index], (UnitResult(unit, Matches.empty(), failure=reason),))

    def _mark_done(self, phase: Phase, indices: Iterable[int]) -> None:
        if phase not in (Phase.SWEEP, Phase.CONNECT):
            finished = [index for index in indices if not self._queue.has_retry(index)]
            self.done.update(finished)
            self.filling.difference_update(finished)

    # What is left

    def wanted(self, record: PairRecord) -> list[Unit]:
        """The units that a pair still gets if there is time."""
        if record.index < len(self._order):
            return record.lacking(self.usable(self.recipe.units))
        is_over = self.phase is Phase.DENSIFY and record.index not in self.filling
        return [] if is_over else record.lacking(self._first)

    def may_gain(self, record: PairRecord) -> bool:
        """Whether a pair can get units that it wants; one with a row only after it got its first."""
        is_ready = record.units or record.index >= len(self._order)
        return bool(is_ready and record.index not in self._stuck and self.wanted(record))

    @property
    def is_complete(self) -> bool:
        """Whether every pair has been reached and nothing is wanted for those that can be worked on."""
        return all(record.reached and not self.may_gain(record) for record in self.records[: len(self._order)])

    @property
    def nothing_runs(self) -> bool:
        """Whether every unit has been given up."""
        return not self.usable(self.recipe.units)

    @property
    def progress(self) -> tuple[Phase, int, int]:
        """The present phase, how many of its pairs are done, and how many it has."""
        asked = len(self._order)
        if self.phase is Phase.SWEEP:
            return self.phase, self._reached, asked
        if self.phase is Phase.DEEPEN:
            return self.phase, len(self.done) - len(self._extra), asked
        if self.phase is Phase.CONNECT:
            return self.phase, self._matched, self._total
        return self.phase, self._total - len(self.filling), self._total

    def explain(self, now: float, text: str) -> None:
        """Note a decision, and why."""
        self.explanations.append(Explanation(now - self.budget.started, text))

    def _lacking_units(self, indices: Iterable[int], units: Sequence[Unit]) -> list[Unit]:
        """Each of the units that some of the pairs have not had, once."""
        return list(dict.fromkeys(unit for index in indices for unit in self.records[index].lacking(units)))

    def _put(self, record: PairRecord) -> None:
        former = self.records[record.index]
        had, lacks = self._lacks(former), self._lacks(record)
        self._lacking.subtract(had - lacks)
        self._lacking.update(lacks - had)
        if record.index < len(self._order):
            self._reached += record.reached - former.reached
        else:
            self._matched += record.reached - former.reached
        self.records[record.index] = record

    def _lacks(self, record: PairRecord) -> set[str]:
        """The units that a pair is to get yet, if it has an F and a row."""
        if not record.units or record.index >= len(self._order):
            return set()
        return {unit.name for unit in record.lacking(self.recipe.units)}
