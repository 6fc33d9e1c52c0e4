"""The engine: sweep, deepen, upgrade; every result is journalled, every version of the submission is whole."""

import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import Any

from tqdm import tqdm

from mkpc_kaggle.competition import Pair
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.run.budget import Budget, Costs, format_duration, longest_prefix
from mkpc_kaggle.run.jobs import Job, JobResult, Outcome, Phase, Record, Task, chunks, visiting_order
from mkpc_kaggle.run.journal import Journal
from mkpc_kaggle.run.worker import Worker

IN_FLIGHT = 2
"""Jobs a worker holds: one is matched while F is estimated for the other."""
PUBLISH_SECONDS = 30.0
EXPLORE_SHARE = 0.25
"""The share of the time left that may be spent to learn what units cost that never ran."""
GRACE_SECONDS = 5.0
"""How long an interrupted run waits for the unit that is running."""


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class RunReport:
    """What a run leaves behind: a record for every pair, in their order, and how it went.

    ``resumed`` pairs were done by earlier runs; ``faults`` are jobs that were lost, with their reasons.
    """

    records: tuple[Record, ...]
    ending: Ending
    seconds: float
    resumed: int
    faults: tuple[str, ...]


class Engine:
    """One run over ``pairs``.

    ``publish`` is called with all records, in the order of ``pairs``, when the run starts, every half minute,
    and when it ends. Setting ``interrupt`` ends the run early, with all rows there.
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        recipe: Recipe,
        worker: Worker,
        journal: Journal,
        budget: Budget,
        *,
        publish: Callable[[Sequence[Record]], None],
        interrupt: threading.Event,
        progress: bool = True,
    ) -> None:
        self.pairs = pairs
        self.recipe = recipe
        self.worker = worker
        self.journal = journal
        self.budget = budget
        self.publish = publish
        self.interrupt = interrupt
        self.progress = progress
        self.costs = Costs()
        self.records = [Record.untouched(index) for index in range(len(pairs))]
        self.faults: list[str] = []
        self._units = {unit.name: unit for unit in recipe.units}
        self._in_flight: deque[Future[JobResult]] = deque()
        self._published = time.monotonic()
        self._last_result = time.monotonic()
        self._wait_until = budget.end

    def run(self) -> RunReport:
        """Run until all is done, the time is up, or an interrupt; raises only what the worker's start raises."""
        for index, record in self.journal.records().items():
            self.records[index] = record
        resumed = sum(not self._lacking(record, self.recipe.regular) for record in self.records)
        self._publish()
        if any(self._wanted(record) for record in self.records):
            self.worker.start()
        for phase in (self._sweep, self._deepen, self._upgrade):
            if self._may_go_on():
                phase()
        self._publish()
        seconds = time.monotonic() - self.budget.started
        return RunReport(tuple(self.records), self._ending(), seconds, resumed, tuple(self.faults))

    def _sweep(self) -> None:
        """The recipe's first unit on all pairs: an F for every pair, early."""
        first = self.recipe.units[:1]
        self._pass(Phase.SWEEP, chunks(visiting_order(self.pairs)), lambda _: first)

    def _deepen(self) -> None:
        """The other units, chunk by chunk: as many as let all remaining pairs have them."""
        self._pass(Phase.DEEPEN, chunks(visiting_order(self.pairs)), self._units_that_fit)

    def _upgrade(self) -> None:
        """What was left out, the weakest pairs first, and for weak ones the extra units."""
        weakest = sorted(self._touched(), key=lambda record: (record.inliers, record.index))
        wanting = [record for record in weakest if self._wanted(record)]
        weak = [record.index for record in wanting if self._weak(record)]
        strong = [record.index for record in wanting if not self._weak(record)]
        self._pass(Phase.UPGRADE, chunks(weak), lambda _: self.recipe.units)
        self._pass(Phase.UPGRADE, chunks(strong), lambda _: self.recipe.regular)

    def _pass(
        self,
        phase: Phase,
        planned: Iterable[tuple[int, ...]],
        choose: Callable[[tuple[int, ...]], tuple[Unit, ...]],
    ) -> None:
        """Hand out the planned chunks with the units that ``choose`` gives each, and gather the results."""
        planned = list(planned)
        total = sum(map(len, planned))
        with tqdm(total=total, desc=phase, unit="pair", disable=not self.progress or total == 0) as bar:
            for indices in planned:
                self._gather(bar, leave=IN_FLIGHT - 1)
                if not self._may_go_on():
                    break
                units = choose(indices)
                todo = [index for index in indices if self._lacking(self.records[index], units)]
                bar.update(len(indices) - len(todo))
                if todo:
                    self._hand_out(phase, todo, units, bar)
            self._gather(bar, leave=0)

    def _units_that_fit(self, indices: tuple[int, ...]) -> tuple[Unit, ...]:
        regular = self.recipe.regular
        lacking: Counter[str] = Counter()
        for record in self._touched():
            lacking.update(unit.name for unit in self._lacking(record, regular))
        count = longest_prefix(regular, lacking, self.costs, self.budget.left())
        return regular[:count]

    def _hand_out(self, phase: Phase, indices: list[int], units: tuple[Unit, ...], bar: "tqdm[Any]") -> None:
        lacking = {unit for index in indices for unit in self._lacking(self.records[index], units)}
        unknown = [unit for unit in units if unit in lacking and not self.costs.known(unit.name)]
        if not unknown:
            self._submit(phase, indices, units, self.budget.stop)
            return
        # What has no known cost cannot be planned: try it on this chunk alone, within an allowance.
        self._gather(bar, leave=0)
        allowance = EXPLORE_SHARE * self.budget.left()
        deadline = time.monotonic() + allowance
        self._submit(phase, indices, units, deadline)
        self._gather(bar, leave=0)
        if time.monotonic() >= deadline:
            for unit in unknown:
                self.costs.suppose(unit.name, allowance)

    def _submit(self, phase: Phase, indices: list[int], units: tuple[Unit, ...], deadline: float) -> None:
        tasks = tuple(
            Task(index, self.pairs[index], self.journal.results(index, self._units)) for index in indices
        )
        expected = tuple(self.costs.of(unit.name) for unit in units)
        if not self._in_flight:
            self._last_result = time.monotonic()
        self._in_flight.append(self.worker.submit(Job(phase, tasks, units, expected, deadline)))

    def _gather(self, bar: "tqdm[Any]", leave: int) -> None:
        """Wait for the oldest jobs until only ``leave`` are in flight."""
        while len(self._in_flight) > leave:
            future = self._in_flight.popleft()
            if not self._arrived(future):
                self._in_flight.clear()
                return
            error = future.exception()
            if error is not None:
                self._fault(f"a job was lost: {type(error).__name__}: {error}")
                continue
            self._take(future.result())
            bar.update(len(future.result().outcomes))
            if isfinite(self.budget.limit):
                bar.set_postfix_str(f"budget left {format_duration(self.budget.left())}")
            if time.monotonic() - self._published > PUBLISH_SECONDS:
                self._publish()

    def _arrived(self, future: "Future[JobResult]") -> bool:
        """Wait for a job, until the time is up or an interrupt's grace has passed."""
        while not future.done() and time.monotonic() < self._wait_until:
            wait([future], timeout=0.2)
            if self.interrupt.is_set():
                self.worker.stop()
                self._wait_until = min(self._wait_until, time.monotonic() + GRACE_SECONDS)
        return future.done()

    def _take(self, result: JobResult) -> None:
        gained = [outcome for outcome in result.outcomes if self._gains(outcome)]
        try:
            self.journal.save([(outcome, not self._wanted(outcome.record)) for outcome in gained])
        except sqlite3.Error as error:
            self._fault(f"the journal cannot be written ({error}): an interrupted run would have to do this again")
        for outcome in gained:
            self.records[outcome.record.index] = outcome.record
        measured = result.measured()
        for unit, seconds in measured:
            self.costs.observe(unit, seconds)
        now = time.monotonic()
        if measured:
            waited = now - self._last_result - sum(seconds for _, seconds in measured)
            self.costs.observe_overhead(waited / len(result.outcomes))
        self._last_result = now

    def _gains(self, outcome: Outcome) -> bool:
        """Whether a job brought anything: a unit more, or the reason why there can be none."""
        record, former = outcome.record, self.records[outcome.record.index]
        return len(record.units) > len(former.units) or (record.reached and not former.reached)

    def _lacking(self, record: Record, units: Iterable[Unit]) -> list[Unit]:
        return [unit for unit in units if not record.has(unit)]

    def _wanted(self, record: Record) -> list[Unit]:
        """The units that a pair shall have if there is time: the extra ones only where it is weak."""
        return self._lacking(record, self.recipe.units if self._weak(record) else self.recipe.regular)

    def _weak(self, record: Record) -> bool:
        return record.inliers < self.recipe.upgrade.below_inliers

    def _touched(self) -> list[Record]:
        """The pairs that can be worked on: those whose images the sweep could read."""
        return [record for record in self.records if record.units]

    def _may_go_on(self) -> bool:
        return not self.interrupt.is_set() and self.budget.left() > 0

    def _publish(self) -> None:
        try:
            self.publish(self.records)
        except OSError as error:
            self._fault(f"the submission cannot be written: {error}")
        self._published = time.monotonic()

    def _fault(self, what: str) -> None:
        if what not in self.faults:
            self.faults.append(what)

    def _ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        finished = all(record.reached and not (record.units and self._wanted(record)) for record in self.records)
        return Ending.COMPLETE if finished else Ending.TIME_IS_UP
