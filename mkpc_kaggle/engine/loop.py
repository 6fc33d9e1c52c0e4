"""The loop of a run, on one thread: give jobs to idle workers, take their answers, publish.

The schedule decides which pairs, estimates and scenes come next
(:mod:`mkpc_kaggle.engine.plan.schedule`). Each kind of work has a file for its jobs and their answers
(:mod:`matching`, :mod:`estimates`, :mod:`scenes`).
"""

import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any, Self

from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.estimates import Estimating, Features
from mkpc_kaggle.engine.jobs import (
    Answer,
    Cause,
    EstimateJob,
    Failure,
    FeatureJob,
    Job,
    Loaded,
    MatchJob,
    SceneJob,
)
from mkpc_kaggle.engine.matching import Matching
from mkpc_kaggle.engine.plan.blame import Item, different
from mkpc_kaggle.engine.plan.budget import Budget, Costs
from mkpc_kaggle.engine.plan.schedule import Crew, NextWork, is_complete, next_work
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.plan.time_limits import start_limit, time_limit
from mkpc_kaggle.engine.publication import Publication
from mkpc_kaggle.engine.request import Ending, Request, RunReport, batches_of
from mkpc_kaggle.engine.restore import restore
from mkpc_kaggle.engine.run import EventLog, JobHandler, Run
from mkpc_kaggle.engine.scenes import SceneWork, scene_failures, scene_records
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import pair_tables
from mkpc_kaggle.engine.store.image_files import current_digests, update_digests
from mkpc_kaggle.engine.store.tables import Feature
from mkpc_kaggle.engine.workers.places import Place, Site, Work
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.densify import extra_pairs_of


@dataclass(frozen=True, eq=False)
class Asked:
    """A request at work: its state, its three kinds of work, and the versions of its results."""

    state: State
    matching: Matching
    estimating: Estimating
    reconstructing: SceneWork
    publication: Publication
    until: float = inf  # no job begins after this time, which is the end of a trial
    resumed: int = 0  # rows that earlier runs finished


class Engine:
    """A run. :meth:`look` and :meth:`ask` compute results that the store does not have.

    Setting ``interrupt`` ends the run early.
    """

    def __init__(
        self,
        site: Site,
        store: Store,
        budget: Budget,
        *,
        interrupt: threading.Event,
        progress: bool = True,
    ) -> None:
        self.site = site
        self.store = store
        self.budget = budget
        self.interrupt = interrupt
        # By this run's answers alone: another machine may have computed the stored results.
        self.costs = Costs()
        self.log = EventLog(store.directory, budget)
        self._progress = Progress(budget, is_shown=progress)
        self._features = Features(store)
        self._asked: Asked | None = None  # the latest request
        self._trials: list[str] = []  # the keys of the results of requests that were trials
        self._refused: dict[str, str] = {}  # why a matcher cannot be loaded, by name
        self._must_replan = False  # a job was dropped, as its points are lost
        self._is_open = False  # the places for matching exist
        self._has_loaded = False  # some worker of matching was ready
        self._has_ended = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End all workers, and publish for the last time."""
        if self._has_ended:  # report() and leaving the context both end the run
            return
        # First, because a worker that writes COLMAP's files must not do so after the last version.
        for place in [*self.site.places, *self.site.fallback]:
            place.kill()
        self.site.close()
        self._progress.close()
        if self._asked is not None:
            self._asked.publication.end()
        self._has_ended = True

    @property
    def state(self) -> State | None:
        """The state of the latest request."""
        return None if self._asked is None else self._asked.state

    # Requests

    def known(self, key: str) -> Any:
        """Return the stored features with this key, a JSON value; ``None`` without any."""
        feature = self.store.get(Feature, [key]).get(key)
        return None if feature is None else feature.value

    def look(self, jobs: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
        """Return features by key, if they are JSON values; ``None`` for data, which the store has.
        Failed ones are left out.
        """
        self._features.ask(jobs)
        self._loop()
        self._features.pending = {}  # the time is over, or the run was interrupted
        return self._features.found

    def ask(self, request: Request, share: float = 1.0) -> None:
        """Compute the missing results of a request. No job begins after ``share`` of the remaining
        time.
        """
        # For the report: an interrupted program has two seconds for it, and the import takes one.
        import_module("pandas")
        batches = batches_of(request.pairs)
        state = State(request, extra_pairs_of(request.pairs, batches, request.recipe.scene))
        if damaged := len(self.store.damaged):
            # They are missing now, like results that never were.
            text = f"{plural(damaged, 'result')} of the journal, damaged, will be computed again"
            self.log.warning(text)
            self.store.damaged.clear()
        # The only time that the store is read for the state: later, answers update it.
        restore(state, self.store, self._digests(state))
        # A worker of an earlier request may have failed to load a matcher already.
        self._leave_out(state)
        # The items of an earlier request's losses are others.
        for place in self.site.places:
            place.lost = []
        run = Run(state, self.store, self.costs, self.budget, self.log, self._progress)
        self._asked = Asked(
            state,
            Matching(run),
            Estimating(run),
            SceneWork(run),
            Publication(state, self.store, self.budget, self.log, self._trials),
            until=self.budget.clock() + share * self.budget.left() if share < 1 else inf,
            resumed=int(state.complete.sum()),
        )
        if self._asked.resumed:
            pairs = plural(state.rows, "pair")
            self._progress.note(f"{self._asked.resumed} of {pairs} from earlier runs")
        # Publish existing results before any work: the F of an earlier run is better than the fallback.
        self._asked.publication.publish()
        self._loop()
        if request.is_trial:
            self._trials += state.result_keys

    def report(self) -> RunReport:
        """End the run. Return the results of the latest request."""
        self._end()
        asked = self._asked
        assert asked is not None, "nothing was asked for"
        unsaved = self.store.flush()  # the disk may have room again
        if unsaved:
            self.log.fault(unsaved)
        return RunReport(
            tables=pair_tables(self.store, asked.publication.version()),
            ending=self.ending,
            seconds=self.budget.spent(),
            resumed=asked.resumed,
            faults=tuple(self.log.faults),
            explanations=tuple(self.log.plans),
            unwritten=asked.publication.unwritten,
            unsaved=unsaved,
            scenes=scene_records(asked.state),
            units_run=self.log.units_run,
            units_failed=self.log.units_failed,
            estimated=self.log.estimated,
            log=self.site.printed(),
            files=asked.state.request.about.files,
            digests=asked.state.digests,
        )

    def save_results(self) -> str:
        """Write the results unless the run has ended. Return why that failed, or an empty text.
        Thread-safe.
        """
        return self._asked.publication.save() if self._asked is not None else ""

    @property
    def ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        state = self.state
        if state is None:
            return Ending.COMPLETE
        if state.unusable.all():
            return Ending.NOTHING_RUNS
        if is_complete(state, self.crew):
            has_failures = state.has_given_up or bool(scene_failures(state))
            return Ending.WITH_FAILURES if has_failures else Ending.COMPLETE
        return Ending.NO_WORKER if self._is_closed else Ending.TIME_IS_UP

    def digest_files(self, files: Mapping[str, Path]) -> dict[str, str]:
        """Return the digest of each file's content, by its name below the root of the images.

        Files that cannot be read are left out.
        """
        return current_digests(self.store, files, self._is_over)

    def _digests(self, state: State) -> dict[str, str]:
        """Return the known digests of the pairs' images, by name; warn of images that have changed."""
        files: dict[str, Path] = {}
        for pair, names in zip(state.pairs, state.names, strict=True):
            files |= zip(names, pair.images, strict=True)
        digests = update_digests(self.store, files, self._is_over)
        if changed := digests.changed:
            count = sum(not changed.isdisjoint(names) for names in state.names)
            images = plural(len(changed), "image")
            self.log.warning(f"{images} changed; matching {plural(count, 'pair')} again")
        return digests.by_name

    # The loop

    def _loop(self) -> None:
        while not self._is_over():
            now = self.budget.clock()
            # All answers first, because each may change the next job.
            for place in self.site.places:
                self._take_answer(place, now)
            self._fall_back()
            if not self._hand_out(now):
                return
            if self._asked is not None and self._asked.publication.is_due(now):
                self._asked.publication.publish()
            # Until an answer, or until a worker must have answered or may be restarted.
            limits = [place.limit for place in self.site.places if place.limit > now]
            self.site.wait(min([self.budget.stop_waiting, *limits, inf]))

    def _is_over(self) -> bool:
        return self.interrupt.is_set() or self.budget.clock() >= self.budget.stop_waiting

    @property
    def crew(self) -> Crew:
        """The workers that exist now, without places that are closed."""
        matchers = [place for place in self.site.of(Work.MATCH) if not place.closed]
        scenes = [place for place in self.site.of(Work.SCENE) if not place.closed]
        return Crew(
            max(1, len(matchers)),  # before the places are open, one is assumed
            len(self.site.of(Work.ESTIMATE)),
            len(scenes),
            # All places of matching have the same kind of device.
            max((place.minibatch for place in matchers), default=1),
            can_match=bool(matchers) or not self._is_open,
        )

    @property
    def _is_closed(self) -> bool:
        """No worker of matching is started any more."""
        return self._is_open and all(place.closed for place in self.site.of(Work.MATCH))

    # Handing out

    def _hand_out(self, now: float) -> bool:
        """Give jobs to idle workers, and start workers for further jobs. Return whether any is
        under way.
        """
        asked = self._asked
        # The number of workers that each kind of work needs besides the busy ones
        needs = dict.fromkeys(Work, 0)
        work = None if asked is None else self._next_work(asked, now)
        if asked is not None and work is not None:
            # A finished run joins no cluster and starts no worker of matching.
            if work.match is not None and not self._is_open:
                self.site.open()
                self._is_open = True
            needs[Work.MATCH] = self._hand_out_pairs(asked, work, now)
            needs[Work.SCENE] = self._hand_out_single_jobs(asked, work, now)
        needs[Work.ESTIMATE] = self._hand_out_estimates(asked, work, now)
        is_under_way = self._must_replan
        self._must_replan = False
        for place in self.site.places:
            if place.may_start(now) and needs[place.work] > 0:
                self._start(place, now)
            if place.is_starting and needs[place.work] > 0:
                is_under_way = True
                if place.work is Work.SCENE:
                    # A process for each scene. Matching and estimates share their workers.
                    needs[place.work] -= 1
            # Even with nothing left to hand out, its answer must be saved.
            if place.job is not None:
                is_under_way = True
        return is_under_way

    def _next_work(
        self, asked: Asked, now: float, lost: Sequence[frozenset[Item]] = ()
    ) -> NextWork | None:
        """Return what to do next, on a place that ``lost`` jobs since its last answer; ``None`` if
        the time of a trial is over.
        """
        if now >= asked.until:
            return None
        work = next_work(asked.state, self.costs, self.budget, self.crew, now, lost)
        if work.match is not None:
            asked.matching.explain(work, self.crew, now)
        return work

    def _hand_out_pairs(self, asked: Asked, work: NextWork, now: float) -> int:
        """Give pairs to idle workers. Return 1 if pairs remain for more workers, else 0."""
        places = self.site.of(Work.MATCH)
        idle = [place for place in places if place.is_idle]
        others = any(place.may_start(now) or place.is_starting for place in places)
        plan = work.match
        while plan is not None and idle:
            # Also losses that an item explains: two places that fail explain each other's.
            if lost := different(idle[0].lost, ()):
                trial = self._next_work(asked, now, lost)
                plan = (trial.match if trial is not None else None) or plan
            # ``None``: the store cannot be read, and the job is planned again in other parts.
            job = asked.matching.job(plan, idle[0].minibatch)
            if job is not None:
                self._give(idle.pop(0), job, now)
            plan = None
            # Planning takes time, so the next job is planned only if a worker could take it.
            if idle or others:
                following = self._next_work(asked, now)
                plan = following.match if following is not None else None
        return int(plan is not None)

    def _hand_out_estimates(self, asked: Asked | None, work: NextWork | None, now: float) -> int:
        """Give features and estimates to idle workers. Return the number of remaining ones."""
        due: list[int] = []
        if asked is not None and work is not None:
            due, _ = self._split_estimates(asked, work)
        for place in [place for place in self.site.of(Work.ESTIMATE) if place.is_idle]:
            # Features first: pairs are chosen by them.
            if self._features.pending:
                self._give(place, self._features.next(), now)
            elif due and asked is not None:
                self._give(place, asked.estimating.job(due, is_trial=bool(place.lost)), now)
                due = [index for index in due if not asked.state.estimating[index]]
        return len(self._features.pending) + len(due)

    def _split_estimates(self, asked: Asked, work: NextWork) -> tuple[list[int], list[int]]:
        """Return the estimates that are due for their workers, and the ones for other processes."""
        due, elsewhere = asked.estimating.split(work.estimates)
        if all(place.closed for place in self.site.of(Work.ESTIMATE)):
            elsewhere += due
            due = []
        if not self.crew.scenes:
            for index in elsewhere:
                asked.estimating.give_up(index)
            return due, []
        return due, elsewhere

    def _hand_out_single_jobs(self, asked: Asked, work: NextWork, now: float) -> int:
        """Give scenes, and estimates that their workers gave up, to idle workers of scenes. Return
        the number of remaining ones that may begin now.
        """
        _, estimates = self._split_estimates(asked, work)
        due = [(batch, ALL_UNITS) for batch in work.scenes] + list(work.candidates)
        places = self.site.of(Work.SCENE)
        for place in [place for place in places if place.is_idle]:
            # Estimates first: scenes wait for them.
            if estimates:
                self._give(place, asked.estimating.job(estimates[:1]), now)
                estimates = [index for index in estimates if not asked.state.estimating[index]]
            elif due:
                self._give(place, asked.reconstructing.job(*due.pop(0)), now)
        # While matching uses the other cores, scenes have only the cores that it leaves free.
        is_matching = work.match is not None or bool(asked.state.matching.any())
        busy = sum(place.job is not None for place in places)
        count = len(estimates) + len(due)
        return min(count, self.site.scenes_at_a_time(is_matching=is_matching) - busy)

    def _start(self, place: Place, now: float) -> None:
        loads_matchers = place.work is Work.MATCH
        place.start(now, start_limit(self.budget, now, loads_matchers=loads_matchers))

    def _give(self, place: Place, job: Job | None, now: float) -> None:
        """Give a job to an idle worker; ``None`` if its points are lost, and it is planned again."""
        if job is None:
            self._must_replan = True
            return
        place.submit(job, time_limit(job, self.costs, self.budget, now), now)

    def _handler(self, job: Job) -> JobHandler:
        """Return the kind of work that a job belongs to."""
        if isinstance(job, FeatureJob):
            return self._features
        asked = self._asked
        assert asked is not None
        match job:
            case MatchJob():
                return asked.matching
            case EstimateJob():
                return asked.estimating
            case SceneJob():
                return asked.reconstructing

    # Answers

    def _take_answer(self, place: Place, now: float) -> None:
        if place.job is not None:
            # By the costs known now: the job may have begun before any cost was measured.
            limit = time_limit(place.job, self.costs, self.budget, place.since)
            place.limit = place.since + limit
        seconds = now - place.since
        answer = place.poll(now)
        if answer is None:
            return
        job = place.job
        place.job = None
        if isinstance(answer, Loaded):
            self._note_loaded(place, answer)
            return
        if isinstance(answer, Failure):
            self._lose(place, job, answer, now)
        elif job is not None:
            self._save(job, answer, seconds)
        if place.work is Work.SCENE:
            place.kill()  # pycolmap's memory does not return

    def _save(self, job: Job, answer: Answer, seconds: float) -> None:
        """Save an answer. If it cannot be saved, only this job fails."""
        handler = self._handler(job)
        try:
            handler.save(job, answer, seconds)
        except sqlite3.Error as error:
            text = f"a result cannot be saved: {error}"
            self.log.fault(text)
            handler.lose(job, Failure(Cause.RAISED, text))
        # A full disk or a lock: the run continues, and the user may make room.
        if self.store.trouble:
            self.log.fault(self.store.trouble)
        if isinstance(job, SceneJob) and job.export is not None and self._asked is not None:
            # COLMAP's files of this batch are complete, so tables of cameras should agree.
            self._asked.publication.publish()

    def _note_loaded(self, place: Place, answer: Loaded) -> None:
        """Continue without the matchers that could not be loaded, and say so once."""
        self._has_loaded = self._has_loaded or place.work is Work.MATCH
        for name, reason in answer.refused.items():
            if name not in self._refused:
                self._refused[name] = reason
                text = f"{name} is left out: {reason}"
                self.log.explain(text)
                self.log.warning(text)
        if self.state is not None:
            self._leave_out(self.state)

    def _leave_out(self, state: State) -> None:
        """Skip the units whose matchers could not be loaded."""
        for unit in state.units:
            if unit.matcher in self._refused:
                failure = Failure(Cause.REFUSED, self._refused[unit.matcher])
                state.give_up(("matcher", unit.name), failure)

    def _lose(self, place: Place, job: Job | None, failure: Failure, now: float) -> None:
        """Record that a worker failed on a job, or could not start."""
        state = self.state
        if job is None:
            self.log.fault(f"{place.name}: {failure}")
        else:
            self.log.fault(f"a job was lost on {place.name}: {failure}")
            # First the items: a loss that they explain does not count against the place.
            self._handler(job).lose(job, failure)
            # A worker that reports an ordinary error works.
            if failure.cause is not Cause.RAISED:
                given_up = () if state is None else state.tries.given_up
                place.lose(job.items, failure, now, given_up)
        if place.closed:
            self.log.explain(f"no worker is started any more on {place.closed}")
            if state is not None and (count := state.forgive(place.lost)):
                units = plural(count, "lost job")
                self.log.explain(f"{units} of {place.name} will be tried again elsewhere")
        # Without a place for scenes, waiting batches must not keep the run from its end.
        if state is not None and place.work is Work.SCENE and not self.crew.scenes:
            state.give_up(("scenes",), failure)

    def _fall_back(self) -> None:
        """Continue on the fallback places once all matching places are closed, or every unit is
        skipped.
        """
        places = self.site.of(Work.MATCH)
        nothing_runs = self.state is not None and bool(self.state.unusable.all())
        reason = "; ".join(place.closed for place in places if place.closed)
        if self.site.fallback and (self._is_closed or nothing_runs):
            name = self.site.fallback[0].name  # the CPU
            text = f"matching continues on the {name}: {reason or Ending.NOTHING_RUNS}"
            self.log.warning(text)
            self.log.explain(text)
            self.site.fall_back()
            # Costs, losses and refusals say nothing about the other device.
            self.costs.forget()
            self._refused = {}
            if self._asked is not None:
                self._asked.matching.forget()
                self._asked.state.forget_failures()
        elif self._is_closed and not self._has_loaded and places:
            raise UserError(f"no worker could be started: {reason}")
