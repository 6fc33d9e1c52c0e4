"""The loop of a run, on one thread: give jobs to idle workers, take their answers, publish.

:class:`mkpc_kaggle.engine.plan.Plan` decides which pairs, estimates and scenes come next.
"""

import json
import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from mkpc_kaggle.engine.budget import (
    COST_OF_ESTIMATES,
    Budget,
    Costs,
    start_limit,
    time_limit,
)
from mkpc_kaggle.engine.frames import Results, results_of
from mkpc_kaggle.engine.keys import of_candidate
from mkpc_kaggle.engine.places import Kind, Place, Site
from mkpc_kaggle.engine.plan import Crew, Plan
from mkpc_kaggle.engine.publish import Publication
from mkpc_kaggle.engine.request import (
    Answer,
    Cause,
    Ending,
    Estimated,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    MatchJob,
    MatchPlan,
    SceneJob,
    keys_of,
)
from mkpc_kaggle.engine.state import (
    ESTIMATE,
    GIVEN_UP,
    NEVER,
    PHASES,
    RAISED,
    REFUSED,
    UNREADABLE,
    State,
)
from mkpc_kaggle.engine.store import Store, points_row, undamaged
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.scene.records import SceneRecord
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.setup.console import Progress, logger

# Pairs of a job of estimates. More would make the last F of a run wait for each other; single pairs, each with a
# message and a transaction, would cost the loop more.
MAX_ESTIMATES = 8
# Losses of a place in a row, without an answer in between, of a new and of a proven place: of 10,000 pairs with
# 5 % bad ones, three in a row are common, and five are not.
MAX_LOSSES, MAX_PROVEN_LOSSES = 3, 5
PROVEN = 20  # answers of a proven place


@dataclass(eq=False)
class Run:
    """A run from a restored state. Setting ``interrupt`` ends it early. ``costs`` are by this run's answers alone:
    another machine may have computed the stored results.
    """

    state: State
    site: Site
    store: Store
    budget: Budget
    interrupt: threading.Event
    progress: Progress
    costs: Costs = field(default_factory=Costs)
    has_loaded: bool = False  # some worker of matching was ready

    def __post_init__(self) -> None:
        state = self.state
        self.about = state.request.about
        self.about.resumed = int((state.done.all(1) & state.estimated)[: state.rows].sum())
        self.publication = Publication(state, self.store, self.budget)

    def run(self) -> Results:
        """Run until nothing is left to do or time is over, and end all workers. Return the results."""
        try:
            self._loop()
        finally:
            self.site.close()
            self.progress.close()
            self.about.ending = self.ending
            self._publish(is_last=True)
        self.about.unsaved = self.store.flush()  # the disk may have room again
        with undamaged(self.store.directory):
            # Facts that a full disk kept from the store
            return replace(results_of(self.store), about=self.about)

    # The loop

    def _loop(self) -> None:
        self._publish()
        while not self.budget.is_over(self.interrupt):
            now = self.budget.clock()
            # All answers first, because each may change the next job.
            for place in self.site.places:
                answer = place.poll(now, self._seconds_of(place))
                if answer is not None:
                    self._take(place, answer, now)
            if self.site.fallback and (self.site.is_closed or self.state.dead.all()):
                self._fall_back()
            plan = self.plan(now)
            for place in self.site.free(now):
                self._give(place, plan)
            if not (self.site.has_jobs or plan.match or plan.estimates or plan.scenes):
                break
            if self.publication.is_due(now):
                self._publish()
            self.site.wait(self.budget.stop_waiting)
        if self.site.is_closed and not self.has_loaded:
            raise UserError(f"no worker could be started: {self.site.reason}")

    def plan(self, now: float, lost: int = 0) -> Plan:
        return Plan(self.state, self.costs, self.budget, self.crew, now, lost)

    @property
    def crew(self) -> Crew:
        """The workers that exist now, without places that are closed."""
        matchers, estimators, scenes = map(self.site.of, Kind)
        # All have the same kind of device.
        minibatch = matchers[0].minibatch if matchers else 1
        return Crew(
            len(matchers), len(estimators), len(scenes), minibatch, self.site.scenes_beside
        )

    def _seconds_of(self, place: Place) -> float:
        """Return how long the worker of a place may start, or compute its job, by the costs known now."""
        if place.job is not None and place.is_loaded:
            return time_limit(place.job, self.costs, self.budget, place.since)
        return start_limit(self.budget, place.since, loads_matchers=place.kind is Kind.MATCH)

    def _take(self, place: Place, answer: Answer, now: float) -> None:
        if isinstance(answer, Loaded):
            self.has_loaded |= place.kind is Kind.MATCH
            for name, reason in answer.refused.items():
                self.fault(f"{name} is left out: {reason}", logging.WARNING)
            is_refused = [unit.matcher in answer.refused for unit in self.state.units]
            self.state.unit_losses[is_refused] = REFUSED
            self.state.dead |= is_refused
            return
        job = place.job
        place.job = None
        if isinstance(answer, Failure):
            self.lose(place, job, answer)
            place.since = now
        elif job is not None:
            place.note_answer()
            self.save(job, answer, now - place.since)
        if job is not None and place.kind is Kind.SCENE:
            place.kill()  # pycolmap's memory does not return

    # Handing out

    def _give(self, place: Place, plan: Plan) -> None:
        """Give a job to a free place, and start a worker there if it has none."""
        job: Job | None = None
        if place.kind is Kind.SCENE and plan.scenes:
            job = self._scene_job(*plan.scenes.pop(0))
        elif place.kind is Kind.ESTIMATE and plan.estimates:
            job = self._estimate_job(plan.estimates)
        elif place.kind is Kind.MATCH:
            # Again if a former place has taken these pairs, and for a place that continues elsewhere.
            if place.lost or (plan.match and self.state.busy[plan.match.pairs].min() < NEVER):
                plan = self.plan(plan.now, len(place.lost))
            if plan.match and not place.is_idle:
                place.start(plan.now)  # after loading, the plan may be another one
            elif plan.match:
                done = self.state.done[: self.state.rows]
                self.progress.count(PHASES[plan.phase], int(done.sum()), done.size, "unit")
                job = self._match_job(plan.match)
        if job is not None:
            place.submit(job, plan.now)

    def _match_job(self, plan: MatchPlan) -> MatchJob:
        state = self.state
        # The points that the last crop comes from; the worker leaves out those after an earlier one.
        last = max((unit for unit in plan.units if state.is_crop[unit]), default=0)
        pairs = tuple(state.inputs_of(pair, state.before[last]) for pair in plan.pairs)
        state.busy[plan.pairs] = plan.phase
        upcoming = [path for index in plan.upcoming for path in state.pairs[index].images]
        # To another machine, if the worker is there
        source = self.store.source(keys_of(pairs), is_sent=True)
        return MatchJob(pairs, state.request.recipe, source, plan, upcoming)

    def _estimate_job(self, due: list[int]) -> EstimateJob:
        """Take the first pairs that are due; one with a lost job is alone."""
        state = self.state
        fresh = [index for index in due[:MAX_ESTIMATES] if not state.losses[index, ESTIMATE]]
        chosen = fresh or due[:1]
        due[:] = [index for index in due if index not in chosen]
        state.estimating[chosen] = True
        pairs = tuple(map(state.inputs_of, chosen))
        return EstimateJob(pairs, state.request.recipe, self.store.source(keys_of(pairs)))

    def _scene_job(self, batch: int, candidate: int) -> SceneJob:
        """Take a batch's candidate, from the results in use now.

        If its pairs get other results meanwhile, the scene is stale when it arrives.
        """
        state = self.state
        request = state.request
        pairs, first = state.scene_inputs(batch)
        name = state.candidates[candidate]
        key = of_candidate(first, name)
        state.making.add((batch, candidate))
        return SceneJob(
            pairs,
            request.recipe,
            self.store.source(keys_of(pairs)),
            (batch, candidate),
            list(state.batches)[batch],
            name,
            key,
            matches=int(state.scene_matches[batch, candidate]),
            folder=None if request.scenes_dir is None else request.scenes_dir / key,
            cameras=request.cameras,
        )

    # Answers

    def save(self, job: Job, answer: object, seconds: float) -> None:
        """Use an answer, and store it in one transaction."""
        self.state.release(job)
        if isinstance(job, MatchJob):
            self._save_points(job, cast(Sequence[PairMatch], answer))
        elif isinstance(job, SceneJob):
            self._save_scene(job, cast(Solution, answer), seconds)
        else:
            self._save_estimates(job, cast(Sequence[Estimated], answer))

    def _save_points(self, job: MatchJob, answer: Sequence[PairMatch]) -> None:
        state = self.state
        rows = []
        for index, outcome in zip(job.indices, answer, strict=True):
            # An unreadable image stays unreadable in this run.
            if outcome.failure:
                state.losses[index, :ESTIMATE] = UNREADABLE
                state.note_reason(index, "", outcome.failure)
            for result in outcome.results:
                unit = state.units.index(result.unit)
                # Failures are not stored: the next run tries them again.
                if result.failure:
                    state.losses[index, unit] = RAISED
                    state.note_reason(index, result.unit.name, result.failure)
                    continue
                # In the recipe's order, as a crop's key has those of the points before it
                key = state.key(index, unit)
                rows.append(points_row(key, result))
                state.use_points(
                    index, unit, key, len(result.matches), is_needed=result.is_needed
                )
                # A unit that the pair does not need took no time.
                if result.is_needed:
                    self.costs.observe(
                        result.unit.name, result.seconds, warm_up=result.warm_up
                    )
                    self.about.units_run += 1
                    # It runs, so its losses are not its own. A unit that is skipped stays so.
                    state.unit_losses[unit] *= state.dead[unit]
        self.store.put({"points": rows})

    def _save_estimates(self, job: Job, answer: Sequence[Estimated]) -> None:
        state = self.state
        rows = []
        for pair, estimate in zip(job.pairs, answer, strict=True):
            # Under the key of the points that the worker read, which may be older than the state's
            key = state.request.keys.of_estimate(pair.points.values())
            rows.append((key, json.dumps(estimate.facts)))
            state.use_estimate(pair.index, key, estimate.facts)
            self.costs.observe(COST_OF_ESTIMATES, estimate.seconds)
        self.store.put({"result": rows})
        self.about.estimated += len(answer)
        # While pairs are matched, the bar shows their units.
        if (state.busy == NEVER).all():
            done = int(state.estimated.sum())
            self.progress.count("estimate", done, state.rows, "pair")

    def _save_scene(self, job: SceneJob, answer: Solution, seconds: float) -> None:
        contents = map(self.state.contents, job.indices)
        record = SceneRecord.of(
            job.batch,
            answer.reconstructions,
            seconds=seconds,
            choices=dict(zip(contents, answer.choices, strict=True)),
            candidate=job.candidate,
            # Later digits vary between processors
            disagreement=float(f"{answer.disagreement:.6g}"),
            key=job.key,
        )
        self.store.put({"result": [(job.key, record.to_json())]})
        # The time of the loop, with the process's start: the forecast needs both.
        self.costs.observe_scene(job.matches, seconds)
        self.state.use_scene(job.scene[0], record)
        # Other candidates are lines of the log.
        say = logger.debug if job.candidate else self.progress.note
        say(f"{job}: {record.registered} of {plural(record.images, 'image')} with a camera")
        if job.folder is not None:
            self._publish()  # tables of cameras should agree with COLMAP's files

    # Losses

    def lose(self, place: Place, job: Job | None, failure: Failure) -> None:
        """Record that a worker failed on a job, or could not start.

        Three rules distinguish a bad place, a bad unit and a bad pair:

        - A lost unit of a pair is tried once more, alone, and then given up in this run.
        - Only a job of pairs that were never lost counts against its place; an estimate only until the place has
          answered. Three in a row, without an answer in between, close it, and its losses are taken back; five
          after twenty answers, or if no other can take over. After a loss, it continues elsewhere in the order.
        - A unit that never ran is at fault itself when it was lost in more jobs than there are places. Where a
          place has answered, that does not count against the place.

        A place that never answered is closed at its first repeated loss, if another can take over.
        """
        if job is not None:
            self.state.release(job)
        if job is None or not place.is_loaded:
            self.fault(f"{place.name}: {failure}")
            place.strikes += 1
        else:
            self.fault(f"a job was lost on {place.name}: {failure}")
            if isinstance(job, SceneJob):
                self._lose_scene(job, failure)
            else:
                self._lose_pairs(place, job, failure)
        is_last = place.is_loaded and not self.site.has_other(place)
        is_proven = place.answers >= PROVEN or is_last
        most = MAX_PROVEN_LOSSES if is_proven else MAX_LOSSES
        # A refusal is an answer of the configuration, which no other worker would change.
        if place.strikes >= most or failure.cause is Cause.REFUSED:
            self._close(place, failure)

    def _lose_scene(self, job: SceneJob, failure: Failure) -> None:
        self.fault(f"{job} was not reconstructed: {failure}")
        state = self.state
        batch, candidate = job.scene
        state.scene_losses[batch, candidate] += 1
        if not candidate and state.scene_losses[batch, candidate] == GIVEN_UP:
            state.scene_failures[batch] = str(failure)

    def _lose_pairs(self, place: Place, job: Job, failure: Failure) -> None:
        state = self.state
        is_fresh = not state.has_losses(job)
        state.lose(job, str(failure))
        # A worker that reports an ordinary error works.
        if failure.cause is Cause.RAISED:
            place.note_answer()
            return
        units = job.plan.units if isinstance(job, MatchJob) else []
        has_run = any(self.costs.mean(state.units[unit].name) for unit in units)
        blamed = units if is_fresh and not has_run else []
        state.unit_losses[blamed] += 1
        place.lost.append((job, blamed))
        if is_fresh:
            self._skip_units(failure)
            place.strikes += not place.answers or (bool(units) and not blamed)
        elif units and not place.answers and self.site.has_other(place):
            place.strikes = MAX_LOSSES

    def _skip_units(self, failure: Failure) -> None:
        """Skip the units that never ran, and were lost in more jobs than there are places."""
        state = self.state
        dead = state.unit_losses > max(1, len(self.site.of(Kind.MATCH)))
        for unit in np.flatnonzero(dead & ~state.dead).tolist():
            self.fault(
                f"{state.units[unit].name} is skipped on all pairs: it never ran ({failure})"
            )
        state.dead = dead

    def _close(self, place: Place, failure: Failure) -> None:
        """Start no worker at a place any more, and take back its losses."""
        state = self.state
        place.closed = f"{place.name}: {failure}"
        self.fault(f"no worker is started any more on {place.closed}")
        for job, blamed in place.lost:
            state.take_back(job)
            state.unit_losses[blamed] -= 1
        self._skip_units(failure)
        if not self.site.of(Kind.SCENE):
            for batch in np.flatnonzero(state.stale).tolist():
                state.scene_failures.setdefault(batch, str(failure))

    def _fall_back(self) -> None:
        """Continue on the fallback places: all matching places are closed, or every unit is skipped."""
        reason = self.site.reason or Ending.NOTHING_RUNS
        self.fault(
            f"matching continues on the {self.site.fallback[0].name}: {reason}",
            logging.WARNING,
        )
        self.site.fall_back()
        # Costs, losses and refusals say nothing about the other device.
        self.costs = Costs()
        self.state.begin_anew()

    # Messages

    def fault(self, text: str, level: int = logging.DEBUG) -> None:
        """Record a fault, if any, once for each text: a broken disk would fill the log with them."""
        faults = self.about.faults
        if text and text not in faults:
            faults.append(text)
            logger.log(level, text)

    # The end

    def _publish(self, *, is_last: bool = False) -> None:
        self.publication.publish(is_last=is_last)
        self.fault(self.about.unwritten)
        self.fault(self.about.unsaved)

    @property
    def ending(self) -> Ending:
        state = self.state
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if state.dead.all():
            return Ending.NOTHING_RUNS
        if self.plan(0).is_complete:
            return Ending.WITH_FAILURES if state.has_failures else Ending.COMPLETE
        if self.site.is_closed or not self.site.of(Kind.ESTIMATE):
            return Ending.NO_WORKER
        return Ending.TIME_IS_UP
