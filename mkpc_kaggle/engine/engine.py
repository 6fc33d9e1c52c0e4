"""The engine: one loop on one thread that hands out jobs, takes in answers, keeps the journal, and publishes."""

import sqlite3
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from math import inf
from types import MappingProxyType

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import console
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.jobs import (
    Answer,
    Failure,
    Loaded,
    MatchJob,
    MatchResult,
    Outcome,
    SceneJob,
    visiting_order,
)
from mkpc_kaggle.engine.journal import Event, EventKind, Journal
from mkpc_kaggle.engine.places import Place, Site
from mkpc_kaggle.engine.plan import Plan
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.engine.scenes import Scenes, extra_pairs_of
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.reconstruct import Solution

MIN_TOLD_PAIRS = 20  # of a batch whose reconstruction is shown: that of a smaller batch takes seconds
PUBLISH_INTERVAL_S, PUBLISH_SHARE = 30.0, 0.05  # how often the submission is written, and its share of the time


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"
    NOTHING_RUNS = "every unit was given up"


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
    explanations: tuple[Event, ...] = ()  # decisions of the plan
    unwritten: str = ""
    scenes: tuple[SceneRecord, ...] = ()
    units_run: int = 0
    estimated_anew: int = 0  # pairs that got another F of the points that the journal had


class Engine:
    """A run over ``pairs``.

    ``publish`` is called with all records, in the order of ``pairs``, and what there is of scenes, when the run
    starts, every half minute (less often where it takes long), after each scene of which COLMAP's files are
    written, and when it ends, in whatever way. Setting ``interrupt`` ends the run early.
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        recipe: Recipe,
        site: Site,
        journal: Journal,
        budget: Budget,
        *,
        publish: Callable[[Sequence[PairRecord], Iterable[SceneRecord]], None],
        interrupt: threading.Event,
        progress: bool = True,
        minibatch: int = 1,
        exports: Mapping[str, Export] = MappingProxyType({}),
    ) -> None:
        self.row_count = len(pairs)
        self.pairs = [*pairs, *extra_pairs_of(pairs, recipe.scene)]
        self.recipe, self.site, self.journal, self.budget = recipe, site, journal, budget
        self.publish, self.interrupt = publish, interrupt
        self.faults: list[str] = []
        self.unwritten = ""
        self._units = {unit.name: unit for unit in recipe.units}
        self._explanations: list[Event] = []
        self._units_run = 0
        self._published = budget.clock()
        self._progress = console.Progress(budget, sys.stderr if progress else None)
        self._publishing = threading.Lock()
        self._has_ended = self._has_loaded = False
        order, records = visiting_order(self.pairs), self._read_records()
        outdated = [record.index for record in records if self._is_outdated(record)]
        self.plan = Plan(order, self.row_count, recipe, records, budget, self._explain, minibatch, outdated)
        site.loads_matchers = any(record.lacking(recipe.units) for record in records)
        self.scenes = Scenes(self.pairs, recipe, self.plan.records, journal.scenes(), exports)
        self._scene_places: list[Place] = []

    def run(self) -> RunReport:
        """Run until all is done, the time is up, or an interrupt.

        Raises :class:`UserError` where no worker can be started.
        """
        resumed = sum(not record.lacking(self.recipe.units) for record in self.records if record.units)
        try:
            self._publish()
            self._loop()
        finally:
            for place in self._places:
                place.kill()
            self.site.close()
            self._progress.close()
            self._publish()
            self._has_ended = True
        return RunReport(
            tuple(self.records),
            self._ending(),
            self.budget.spent(),
            resumed,
            tuple(self.faults),
            tuple(self._explanations),
            self.unwritten,
            self.scenes.report(),
            self._units_run,
            self.plan.estimated_anew,
        )

    @property
    def records(self) -> list[PairRecord]:
        """Of the pairs that have a row, in their order."""
        return self.plan.records[: self.row_count]

    @property
    def _places(self) -> list[Place]:
        return [*self.site.places, *self._scene_places]

    @property
    def _is_closed(self) -> bool:
        """Whether no worker is started at any place any more."""
        return bool(self.site.places) and all(place.closed for place in self.site.places)

    def save_results(self) -> str:
        """Write the results, unless the run has ended; why it cannot be written. For any thread."""
        with self._publishing:
            if not self._has_ended:
                try:
                    self.publish(self.records, list(self.scenes.made.values()))
                    self.unwritten = ""
                except OSError as error:
                    self.unwritten = f"the results cannot be written: {error}"
        return self.unwritten

    # The loop

    def _loop(self) -> None:
        if self.plan.advance(self.budget.clock()) or self.scenes.due(range(len(self.pairs))) is not None:
            self.site.open()
        while not self.interrupt.is_set() and (now := self.budget.clock()) < self.budget.stop_waiting:
            for place in self._places:
                self._take_answer(place, now)
            self._fall_back(now)
            self._hand_out(now)
            is_matching = self._is_matching(now)
            self._start_scenes(now, is_matching=is_matching and now < self.plan.stop)
            if not is_matching and not self._scene_places:
                return
            if now - self._published > max(PUBLISH_INTERVAL_S, self.budget.writing / PUBLISH_SHARE):
                self._publish()
            limits = (place.limit for place in self._places)
            self.site.wait(min(self.budget.stop_waiting, *(limit for limit in limits if limit > now), inf))

    def _hand_out(self, now: float) -> None:
        """A worker for each place that has none, and a job for each worker that is idle."""
        self.plan.reserve = self.scenes.reserve(self.site.scenes_at_once)
        self.plan.workers = max(1, sum(not place.closed for place in self.site.places))
        for place in self.site.places:
            if place.may_start(now) and self.plan.advance(now):
                place.start(now)
            elif place.is_idle and (job := self.plan.next(now, place.name, cautious=place.losses > 0)):
                pairs = tuple(self.pairs[index] for index in job.indices)
                job = replace(job, pairs=pairs, known=tuple(map(self._known, job.indices)))
                place.submit(job, job.seconds, job.time_limit, now)

    def _is_matching(self, now: float) -> bool:
        """Whether a job is under way, or will be when a worker has started."""
        places, may_begin = self.site.places, self.plan.advance(now)
        return any(place.job is not None or (place.is_starting and may_begin) for place in places)

    def _take_answer(self, place: Place, now: float) -> None:
        answer, job, seconds = place.poll(now), place.job, now - place.since
        if isinstance(answer, Loaded):
            self._has_loaded = True
            if isinstance(job, SceneJob):
                self.scenes.on_start(seconds)
                place.submit(job, inf, self.scenes.time_limit(job.batch, self.budget.left()), now)
        elif answer is not None:
            place.job = None
            if isinstance(job, SceneJob):
                self._scene_places.remove(place)
                place.kill()
                self._take_scene(job, answer, seconds)
            elif isinstance(answer, Failure):
                self._fault(f"a job was lost on {place.name}: {answer}" if job else f"{place.name}: {answer}")
                if isinstance(job, MatchJob):
                    self._keep(self.plan.on_failure(job, answer, place.name))
                if place.closed:
                    self._explain(f"no worker is started any more on {place.closed}")
            elif isinstance(job, MatchJob) and isinstance(answer, MatchResult):
                self._units_run += len(answer.results)
                self._keep(self.plan.on_result(job, answer, seconds))
                self._note(EventKind.JOB, f"{job.phase} {len(job.indices)} pairs {answer.unit_seconds:.3f} s")
            self._progress.show(*self.plan.progress)

    def _fall_back(self, now: float) -> None:
        """Go on elsewhere when the last place is closed, or had to give up every unit."""
        reason = "; ".join(place.closed for place in self.site.places if place.closed)
        if self.site.fallback and (self._is_closed or self.plan.nothing_runs):
            why = reason if self._is_closed else Ending.NOTHING_RUNS
            text = f"the work goes on on the {self.site.fallback[0].name}: {why}"
            self._fault(text)
            console.warn(text)
            for place in self.site.places:
                place.kill()
            self.site.places, self.site.fallback = self.site.fallback, []
            self._explain(text)
            self._keep(self.plan.restart())
        elif self._is_closed and not self._has_loaded:
            raise UserError(f"no worker could be started: {reason}")

    # Scenes

    def _start_scenes(self, now: float, *, is_matching: bool) -> None:
        """Begin to reconstruct batches whose pairs have what fits; all when nothing is matched any more."""
        at_once, plan = self.site.scenes_at_once, self.plan
        done, filling = (plan.done, plan.filling) if is_matching else (range(len(self.pairs)), ())
        while len(self._scene_places) < at_once and (batch := self.scenes.due(done, filling)) is not None:
            place = Place(f"scene of batch {batch}", self.site.scene_worker)
            place.job = self.scenes.job(batch, self._known)
            self._tell(place.job, f"its cameras are reconstructed from {len(place.job.pairs)} pairs")
            self._scene_places.append(place)
            place.start(now, self.scenes.start_timeout(self.budget.left()))

    def _take_scene(self, job: SceneJob, answer: Answer, seconds: float) -> None:
        if isinstance(answer, Failure):
            self._fault(f"batch {job.batch} was not reconstructed: {answer}")
            self.scenes.on_failure(job, str(answer))
            return
        assert isinstance(answer, Solution)
        records, estimation = self.plan.records, self.recipe.scene_estimation
        record = SceneRecord.of(job.batch, answer.reconstructions, job.unit_results, seconds, estimation)
        self.scenes.on_result(job, record)
        for index, choice in zip(job.indices, answer.choices, strict=True):
            records[index] = replace(records[index], scene=choice)
        text = f"{record.registered} of {record.images} images"
        self._note(EventKind.SCENE, f"{record.batch}: {text}")
        self._tell(job, f"{text} have a camera")
        members = [records[index] for index in self.scenes.batches[job.batch]]
        self._save(partial(self.journal.save_scene, record, members))
        if job.export is not None:
            self._publish()

    # The journal and the submission

    def _read_records(self) -> list[PairRecord]:
        has_scenes = self.recipe.scene is not None
        if forgotten := self.journal.forget_outdated(self.pairs, has_scenes=has_scenes):
            text = f"images have changed since they were matched: {forgotten} pairs are matched anew"
            console.warn(text)
            self._fault(text)
        records = self.journal.records()
        return [records.get(index) or PairRecord.untouched(index) for index in range(len(self.pairs))]

    def _is_outdated(self, record: PairRecord) -> bool:
        """Whether a pair has the F of another estimation."""
        wanted = self.recipe.pair_estimation(self.pairs[record.index].intrinsics)
        return record.matches > 0 and record.estimation != wanted

    def _known(self, index: int) -> PairMatch:
        """What earlier jobs found on a pair."""
        record, results = self.plan.records[index], tuple[UnitResult, ...]()
        try:
            results = self.journal.results(record, self._units)
        except UserError as error:  # without them a job gains nothing, and the F stays
            self._fault(str(error))
        return PairMatch(results, sizes=record.sizes, versions=record.versions, focals=record.focals)

    def _keep(self, outcomes: Sequence[Outcome]) -> None:
        """Put outcomes into the journal; the scenes of their batches are out of date."""
        for outcome in outcomes:
            gained = sum(len(result.matches) for result in outcome.results)
            self.scenes.note_change(outcome.record.index, gained)
        self._save(partial(self.journal.save, outcomes))

    def _save(self, write: Callable[[], None]) -> None:
        """Write to the journal: a full disk costs what a later run would have had of it."""
        try:
            write()
        except (sqlite3.Error, ValueError) as error:
            self._fault(f"the journal cannot be written ({error}): an interrupted run would have to do this again")

    def _explain(self, text: str) -> None:
        self._explanations.append(self._note(EventKind.PLAN, text))

    def _note(self, kind: EventKind, text: str) -> Event:
        event = Event(kind, self.budget.spent(), text)
        self.journal.note(event)
        return event

    def _tell(self, job: SceneJob, text: str) -> None:
        """Show a step of a reconstruction that may take minutes."""
        if len(job.pairs) >= MIN_TOLD_PAIRS:
            self._progress.note(f"batch {job.batch}: {text}")

    def _fault(self, what: str) -> None:
        if what not in self.faults:
            self.faults.append(what)
            self._note(EventKind.FAULT, what)

    def _publish(self) -> None:
        start = self.budget.clock()
        if trouble := self.save_results():
            self._fault(trouble)
        self._published = self.budget.clock()
        self.budget.note_write(self._published - start)

    def _ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if self.plan.nothing_runs:
            return Ending.NOTHING_RUNS
        if self.plan.is_complete and self.scenes.is_complete:
            return Ending.COMPLETE
        return Ending.NO_WORKER if self._is_closed else Ending.TIME_IS_UP
