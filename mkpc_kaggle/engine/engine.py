"""The engine: plans, jobs and results, journalled as they come; every version of the submission is whole."""

import sqlite3
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf
from typing import Protocol

from mkpc_kaggle.data.competition import Pair, uncollected
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.engine.jobs import Job, JobFailure, JobResult, Outcome, visiting_order
from mkpc_kaggle.engine.journal_tables import EventKind
from mkpc_kaggle.engine.planner import Explanation, Planner
from mkpc_kaggle.engine.pools.pool import Pool
from mkpc_kaggle.engine.progress import progress_on
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.engine.scenes import SceneJob, SceneQueue, SceneResult, pairs_to_add
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

PUBLISH_SECONDS, PUBLISH_SHARE = 30.0, 0.05
"""How often the submission is written: at most that share of the time goes into it."""
WRITING_DOUBT = 1.5
"""How much longer than it ever took writing the submission may take."""
LISTEN_SECONDS = 0.2
"""How often an interrupt is looked for."""
GRACE_SECONDS = 5.0
"""How long an interrupted run waits for the unit that is running."""


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"


@dataclass(frozen=True)
class RunReport:
    """What a run leaves behind: a record for every pair, in their order, and how it went.

    ``resumed`` pairs were done by earlier runs; ``faults`` are jobs that were lost and files that could not be
    written, with their reasons; ``unwritten`` says why the last version of the submission could not be. ``scenes``
    are the batches that were reconstructed, or could not be.
    """

    records: tuple[PairRecord, ...]
    ending: Ending
    seconds: float
    resumed: int
    faults: tuple[str, ...]
    explanations: tuple[Explanation, ...] = ()
    unwritten: str = ""
    scenes: tuple[SceneRecord, ...] = ()


class RunJournal(Protocol):
    """What the engine wants of a journal."""

    def forget_changed(self, pairs: Sequence[Pair]) -> int: ...

    def records(self) -> dict[int, PairRecord]: ...

    def results(self, pair: int, units: Mapping[str, Unit]) -> tuple[UnitResult, ...]: ...

    def save(self, outcomes: list[tuple[Outcome, bool]]) -> None: ...

    def scenes(self) -> tuple[SceneRecord, ...]: ...

    def save_scene(self, scene: SceneRecord, choices: Mapping[int, Choice]) -> None: ...

    def settle(self, records: Iterable[PairRecord]) -> None: ...

    def note(self, kind: str, seconds: float, text: str) -> None: ...


class Engine:
    """One run over ``pairs``.

    ``publish`` is called with all records, in the order of ``pairs``, when the run starts, every half minute (less
    often where it takes long), and when it ends. Setting ``interrupt`` ends the run early, with all rows there.
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        recipe: Recipe,
        pool: Pool,
        journal: RunJournal,
        budget: Budget,
        *,
        publish: Callable[[Sequence[PairRecord]], None],
        interrupt: threading.Event,
        progress: bool = True,
        timeouts: Timeouts | None = None,
    ) -> None:
        self.asked = len(pairs)
        self.pairs = [*pairs, *pairs_to_add(pairs, recipe.scene)]
        self.recipe = recipe
        self.pool = pool
        self.journal = journal
        self.budget = budget
        self.publish = publish
        self.interrupt = interrupt
        self.faults: list[str] = []
        self.unwritten = ""
        self._units = {unit.name: unit for unit in recipe.units}
        self._unjournalled: dict[int, tuple[UnitResult, ...]] = {}
        self._out = self._explained = 0
        self._published = budget.clock()
        self._grace_ends = inf
        self._progress = progress_on(sys.stderr, budget) if progress else None
        self._publishing = threading.Lock()
        self._ended = False
        self.planner = self._planner(timeouts)
        self.scenes = SceneQueue(self.pairs, recipe.scene, budget.clock, self.planner.timeouts, budget.limit)
        self._scene_records = {scene.batch: scene for scene in journal.scenes()}
        self.scenes.note_solved(record.index for record in self.planner.records if record.scene is not None)

    def run(self) -> RunReport:
        """Run until all is done, the time is up, or an interrupt; raises only what the pool's start raises."""
        self._publish()
        regular = self.recipe.regular
        resumed = sum(not record.lacking(regular) for record in self.records if record.units)
        try:
            if any(self.planner.wanted(record) for record in self.records):
                if message := self.pool.start():
                    warnings.warn(message, stacklevel=2)  # now, since the summary is hours away
                    self._fault(message)
                while self._work():
                    self._finish()  # what scenes need less than was kept for them is matching's again
            self._finish()
        finally:
            self.scenes.close()
        if self._progress is not None:
            self._progress.close()
        self._publish()
        self._ended = True
        self._note_explanations()
        return RunReport(
            tuple(self.records),
            self._ending(),
            self.budget.spent(),
            resumed,
            tuple(self.faults),
            tuple(self.planner.explanations),
            self.unwritten,
            tuple(self._scene_records.values()),
        )

    @property
    def records(self) -> list[PairRecord]:
        """Those of the pairs that were asked for, in their order."""
        return self.planner.records[: self.asked]

    def save_what_there_is(self) -> str:
        """Write the submission from another thread, unless the run has ended by itself; why it could not be.

        Waits for the engine's own thread until the limit is almost over where that is at it.
        """
        left = self.budget.over - self.budget.reserve / 8 - self.budget.clock()
        if not self._publishing.acquire(timeout=max(0.0, left)):
            return "the time was up before the last version of the submission was written"
        if not self._ended:
            self._write()
        return self.unwritten

    @uncollected()
    def _planner(self, timeouts: Timeouts | None) -> Planner:
        if forgotten := self.journal.forget_changed(self.pairs):
            text = f"images have changed since they were matched: {forgotten} pairs are matched anew"
            warnings.warn(text, stacklevel=2)
            self._fault(text)
        records = [PairRecord.untouched(index) for index in range(len(self.pairs))]
        for index, record in self.journal.records().items():
            records[index] = record
        asked, unasked = self.pairs[: self.asked], self.pairs[self.asked :]
        return Planner(
            visiting_order(asked),
            self.recipe,
            records,
            self.budget,
            timeouts=timeouts,
            unasked=[self.asked + place for place in visiting_order(unasked)],
        )

    def _work(self) -> bool:
        """Hand out what is planned as long as there is room, and gather what comes back; whether there was any."""
        begun = False
        while self._may_hand_out():
            self._reconstruct(self.planner.deepened)
            self.planner.workers = max(1, self.pool.workers)
            while self._out < self.pool.capacity:
                job = self.planner.next(self.budget.clock())
                if job is None:
                    break
                self._submit(job)
                begun = True
            if self._out == 0:
                return begun
            while not self._gather() and self._may_hand_out():
                self._reconstruct(self.planner.deepened)  # only a job that comes back changes the plan
        return begun

    def _may_hand_out(self) -> bool:
        return not self.interrupt.is_set() and self.budget.clock() < self.planner.stop

    def _finish(self) -> None:
        """Let what is under way end and reconstruct what is left, until nothing is waited for any longer.

        What is left are the batches that were not done beside matching, and those that changed since.
        """
        everything = set(range(len(self.pairs)))
        while self.budget.clock() < self._wait_until:
            if self.interrupt.is_set():
                self._cut_short()
            else:
                self._reconstruct(everything, again=True)
            if self._out == 0 and (self.interrupt.is_set() or not self.scenes.running):
                return
            self._gather()

    def _cut_short(self) -> None:
        if self._grace_ends == inf:
            self.pool.stop()
            self._grace_ends = self.budget.clock() + GRACE_SECONDS

    def _reconstruct(self, matched: set[int], *, again: bool = False) -> None:
        """Take reconstructions back, and begin those whose pairs are all ``matched``."""
        for result in self.scenes.finished():
            self._keep_scene(result)
        at_once = self.pool.scenes_at_once
        while len(self.scenes.running) < at_once and self.budget.left() > 0:
            batch = self.scenes.due(matched, again=again)
            if batch is None:
                break
            self.scenes.start(batch, self.pool.reconstruct(self._scene_job(batch)))
        self.planner.reserve = self.scenes.reserve(at_once)

    def _scene_job(self, batch: str) -> SceneJob:
        recipe = self.recipe
        assert recipe.scene is not None
        found = tuple(index for index in self.scenes.batches[batch] if self.planner.records[index].units)
        pairs = tuple(map(self._batch_pair, found))
        return SceneJob(batch, found, pairs, recipe.scene, recipe.focal, recipe.magsac)

    def _batch_pair(self, index: int) -> BatchPair:
        record, results = self.planner.records[index], self._results(index)
        image0, image1 = self.pairs[index].images
        return BatchPair(
            BatchImage(str(image0), "", Size(0, 0)),
            BatchImage(str(image1), "", Size(0, 0)),
            Matches.concatenate(result.matches for result in results),
            None if record.failure else record.F,
            tracks_of(results),
        )

    def _keep_scene(self, result: SceneResult) -> None:
        record = SceneRecord.of(result.batch, result.scenes, result.seconds, result.failure)
        if result.failure:
            self._fault(f"batch {result.batch} was not reconstructed: {result.failure}")
            if result.batch in self._scene_records:
                return  # what was found before its pairs got further matches still stands
        self._scene_records[result.batch] = record
        for index, choice in result.choices.items():
            self.planner.state.set_scene(index, choice)
        self._note(EventKind.SCENE, f"{record.batch}: {record.placed} of {record.images} images")
        records = [self.planner.records[index] for index in self.scenes.batches[result.batch]]
        # A batch is reconstructed from the points of all its pairs: none can go while one of them may change.
        may_change = any(self.planner.may_gain(one) or self.scenes.needs(one.index) for one in records)
        try:
            self.journal.save_scene(record, result.choices)
            if not result.failure and not may_change:
                self.journal.settle(one for one in records if one.units)
        except sqlite3.Error as error:
            self._fault(f"the journal cannot be written ({error}): an interrupted run would have to do this again")

    @property
    def _wait_until(self) -> float:
        """When nothing is waited for any longer."""
        return min(self._grace_ends, self.budget.end)

    def _submit(self, job: Job) -> None:
        self._out += 1
        pairs = tuple(self.pairs[index] for index in job.indices)
        self.pool.submit(replace(job, pairs=pairs, known=tuple(map(self._results, job.indices))))

    def _results(self, index: int) -> tuple[UnitResult, ...]:
        """What earlier jobs found on a pair."""
        if not self.planner.records[index].units:
            return ()
        if index in self._unjournalled:
            return self._unjournalled[index]
        try:
            return self.journal.results(index, self._units)
        except (sqlite3.Error, UserError) as error:  # without them a job gains nothing, and the F stays
            self._fault(f"the journal cannot be read ({error})")
            return ()

    def _gather(self) -> bool:
        """Take one job back; whether one came."""
        back = self.pool.next(min(self.budget.clock() + LISTEN_SECONDS, self._wait_until))
        if back is None:
            return False
        self._out -= 1
        now = self.budget.clock()
        if isinstance(back, JobFailure):
            self._fault(f"a job was lost: {back}")
            self._keep(self.planner.lose(back, now))
        else:
            self._keep(self.planner.take(back, now))
            self._note_job(back)
        self._note_explanations()
        if self._progress is not None:
            self._progress.show(*self.planner.progress)
        if now - self._published > max(PUBLISH_SECONDS, self.budget.writing / PUBLISH_SHARE):
            self._publish()
        return True

    def _keep(self, outcomes: Sequence[Outcome]) -> None:
        """Put outcomes into the journal; into memory those that it cannot take."""
        if not outcomes:
            return
        for outcome in outcomes:
            self.scenes.note_change(outcome.record.index)
        settled = [
            not self.planner.wanted(outcome.record) and not self.scenes.needs(outcome.record.index)
            for outcome in outcomes
        ]
        try:
            former = [self._unjournalled.get(outcome.record.index, ()) for outcome in outcomes]
            whole = [
                Outcome(outcome.record, before + outcome.results)
                for outcome, before in zip(outcomes, former, strict=True)
            ]
            self.journal.save(list(zip(whole, settled, strict=True)))
        except sqlite3.Error as error:
            self._fault(f"the journal cannot be written ({error}): an interrupted run would have to do this again")
            for outcome, done in zip(outcomes, settled, strict=True):
                index = outcome.record.index
                self._unjournalled[index] = () if done else self._results(index) + outcome.results
            return
        for outcome in outcomes:
            self._unjournalled.pop(outcome.record.index, None)

    def _note_job(self, back: JobResult) -> None:
        job = back.job
        self._note(EventKind.BUDGET, job.phase)
        self._note(EventKind.JOB, f"{job.phase} {len(job.indices)} pairs {back.unit_seconds:.3f} s")

    def _note_explanations(self) -> None:
        for one in self.planner.explanations[self._explained :]:
            self.journal.note(EventKind.PLAN, one.seconds, one.text)
        self._explained = len(self.planner.explanations)

    def _note(self, kind: EventKind, text: str) -> None:
        self.journal.note(kind, self.budget.spent(), text)

    def _publish(self) -> None:
        start = self.budget.clock()
        with self._publishing:
            self._write()
        self._published = self.budget.clock()
        self.budget.writing = max(self.budget.writing, WRITING_DOUBT * (self._published - start))
        if self.unwritten:
            self._fault(self.unwritten)

    def _write(self) -> None:
        try:
            self.publish(self.records)
            self.unwritten = ""
        except OSError as error:
            self.unwritten = f"the submission cannot be written: {error}"

    def _fault(self, what: str) -> None:
        if what not in self.faults:
            self.faults.append(what)
            self._note(EventKind.FAULT, what)

    def _ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if self.planner.complete:
            return Ending.COMPLETE
        return Ending.TIME_IS_UP if self.pool.workers else Ending.NO_WORKER
