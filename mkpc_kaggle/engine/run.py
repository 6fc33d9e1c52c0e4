"""The loop of a run, on one thread: give jobs to idle workers, take their answers, publish.

:func:`mkpc_kaggle.engine.plan.plan` decides which pairs, estimates and scenes come next.
"""

import json
import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Self, cast

from mkpc_kaggle.engine.budget import COST_OF_ESTIMATES, Budget, Costs, start_limit, time_limit
from mkpc_kaggle.engine.console import Progress, logger
from mkpc_kaggle.engine.frames import Results, results_of
from mkpc_kaggle.engine.keys import of_candidate
from mkpc_kaggle.engine.places import Kind, Place, Site
from mkpc_kaggle.engine.plan import Crew, MatchPlan, NextWork, is_complete, plan
from mkpc_kaggle.engine.publish import Publication
from mkpc_kaggle.engine.request import (
    About,
    Answer,
    Cause,
    Ending,
    Estimated,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    MatchJob,
    SceneJob,
)
from mkpc_kaggle.engine.state import DEEPEN, ESTIMATE, NEVER, PHASES, RAISED, State
from mkpc_kaggle.engine.store import Store, points_row
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.scene.candidates import ALL_UNITS, title_of
from mkpc_kaggle.scene.records import SceneRecord
from mkpc_kaggle.scene.sfm import Solution

# Pairs of a job of estimates. More would make the last F of a run wait for each other; single pairs, each with a
# message and a transaction, would cost the loop more.
MAX_ESTIMATES = 8
MAX_LOSSES = 3  # of a place in a row, without an answer in between
# Times the losses of a place in a row: scarce memory may become free meanwhile
RESTART_PAUSE_S = 1.0
MAX_FAULTS = 1000  # with different texts


class Run:
    """A run from a restored state. Setting ``interrupt`` ends it early. Leaving the context ends the workers
    and publishes.
    """

    def __init__(
        self,
        state: State,
        site: Site,
        store: Store,
        budget: Budget,
        *,
        interrupt: threading.Event,
        progress: bool = True,
    ) -> None:
        self.state = state
        self.site = site
        self.store = store
        self.budget = budget
        self.interrupt = interrupt
        # By this run's answers alone: another machine may have computed the stored results.
        self.costs = Costs()
        self.faults: list[str] = []
        self.units_run = self.estimated = 0
        self.resumed = int(state.complete.sum())
        self.publication = Publication(state, store, budget)
        self._progress = Progress(budget.left, is_shown=progress)
        self._explained = ""  # the phase that was explained last
        self._has_loaded = False  # some worker of matching was ready
        self._has_ended = False
        # For the report: an interrupted program has two seconds for it, and the import takes one.
        import_module("pandas")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End all workers, and publish for the last time."""
        if not self._has_ended:  # report() and leaving the context both end the run
            self._has_ended = True
            self.site.close()
            self.state.making.clear()
            self._progress.close()
            self._publish()

    # The loop

    def run(self) -> None:
        if self.resumed:
            pairs = plural(self.state.rows, "pair")
            self._say(f"{self.resumed} of {pairs} from earlier runs")
        self._publish()
        while not self.is_over():
            now = self.budget.clock()
            # All answers first, because each may change the next job.
            for place in self.site.places:
                answer = place.poll(now, self._seconds_of(place))
                if answer is not None:
                    self._take(place, answer, now)
            if self.site.fallback and (self.site.is_closed or self.state.dead.all()):
                self._fall_back()
            work = self.plan(now)
            for place in self.site.free(now):
                self._give(place, work, now)
            if not (work.match or work.estimates or work.scenes or self.site.has_jobs):
                break
            if self.publication.is_due(now):
                self._publish()
            self.site.wait(self.budget.stop_waiting)
        if self.site.is_closed and not self._has_loaded:
            raise UserError(f"no worker could be started: {self.site.reason}")

    def is_over(self) -> bool:
        return self.interrupt.is_set() or self.budget.clock() >= self.budget.stop_waiting

    def plan(self, now: float, lost: int = 0) -> NextWork:
        return plan(self.state, self.costs, self.budget, self.crew, now, lost)

    @property
    def crew(self) -> Crew:
        """The workers that exist now, without places that are closed."""
        site = self.site
        matchers = site.of(Kind.MATCH)
        # All have the same kind of device.
        minibatch = max((place.minibatch for place in matchers), default=1)
        return Crew(len(matchers), len(site.of(Kind.ESTIMATE)), len(site.of(Kind.SCENE)), minibatch)

    def _seconds_of(self, place: Place) -> float:
        """Return how long the worker of a place may start, or compute its job, by the costs known now."""
        if place.job is not None:
            return time_limit(place.job, self.costs, self.budget, place.since)
        loads_matchers = place.kind is Kind.MATCH
        return start_limit(self.budget, place.since, loads_matchers=loads_matchers)

    def _take(self, place: Place, answer: Answer, now: float) -> None:
        job, place.job = place.job, None
        if isinstance(answer, Failure):
            self.lose(place, job, answer, now)
        elif job is None:
            self._has_loaded = self._has_loaded or place.kind is Kind.MATCH
            self._leave_out(cast(Loaded, answer))
        else:
            place.note_answer()
            self.save(job, answer, now - place.since)
        if job is not None and place.kind is Kind.SCENE:
            place.kill()  # pycolmap's memory does not return

    # Handing out

    def _give(self, place: Place, work: NextWork, now: float) -> None:
        """Give a job to a free place, or start a worker there if there is one to give."""
        job: Job | None = None
        if place.kind is Kind.MATCH:
            # Again if a former place has taken these pairs, and for a place that continues elsewhere.
            is_taken = work.match and self.state.busy[work.match.pairs].min() < NEVER
            if place.lost or is_taken:
                work = self.plan(now, len(place.lost))
            if work.match is not None:
                self._show(work.match.phase, work.fit)
                job = self._match_job(work.match) if place.is_idle else None
        elif place.kind is Kind.ESTIMATE and work.estimates:
            job = self._estimate_job(work.estimates) if place.is_idle else None
        elif place.kind is Kind.SCENE and work.scenes:
            job = self._scene_job(*work.scenes.pop(0)) if place.is_idle else None
        else:
            return
        if job is not None:
            place.submit(job, now)
        elif not place.is_idle and self._has_room(place, work):
            place.start(now)

    def _has_room(self, place: Place, work: NextWork) -> bool:
        """Return whether another worker may start: there is work for it, and for a scene a core."""
        if place.kind is not Kind.SCENE:
            return place.kind is not Kind.MATCH or work.match is not None
        places = self.site.of(Kind.SCENE)
        starting = sum(place.is_starting for place in places)
        # While matching uses the other cores, scenes have only the cores that it leaves free.
        is_matching = work.match is not None or self.state.is_matching
        most = self.site.scenes_at_a_time(is_matching=is_matching)
        busy = starting + sum(place.job is not None for place in places)
        return starting < len(work.scenes) and busy < most

    def _match_job(self, chosen: MatchPlan) -> MatchJob | None:
        state = self.state
        crops = [number for number in chosen.units if state.is_crop[number]]
        # The points that the last crop comes from; the worker leaves out those after an earlier one.
        inputs = [state.points_before(index, max(crops, default=0)) for index in chosen.pairs]
        keys = [key for points in inputs for key in points.values()]
        job = MatchJob(
            chosen.pairs,
            [state.units[number] for number in chosen.units],
            chosen.expected,
            chosen.seconds,
            [state.pairs[index] for index in chosen.pairs],
            [tuple(image.digest for image in state.images_of(index)) for index in chosen.pairs],
            upcoming=[path for index in chosen.upcoming for path in state.pairs[index].images],
        )
        try:
            points = self.store.source(keys).matches(keys)
        except (UserError, sqlite3.Error, KeyError) as error:  # a disk that fails costs the job
            self._lose_job(job, f"the store cannot be read: {error}")
            return None
        state.busy[chosen.pairs] = chosen.phase
        given = [
            tuple(UnitResult(unit, points[key]) for unit, key in pair.items()) for pair in inputs
        ]
        return replace(job, given=given)

    def _estimate_job(self, due: list[int]) -> EstimateJob:
        """Take the first pairs that are due; one with a lost job is alone."""
        state = self.state
        fresh = [index for index in due[:MAX_ESTIMATES] if not state.losses[index, ESTIMATE]]
        chosen = fresh or due[:1]
        due[:] = [index for index in due if index not in chosen]
        state.estimating[chosen] = True
        pairs = tuple(map(state.inputs_of, chosen))
        keys = [key for pair in pairs for key in pair.points.values()]
        return EstimateJob(pairs, state.request.recipe, self.store.source(keys))

    def _scene_job(self, batch: int, candidate: str) -> SceneJob:
        """Take a batch's candidate, from the results in use now.

        If its pairs get other results meanwhile, the scene is stale when it arrives.
        """
        state = self.state
        request = state.request
        indices, first = state.scene_inputs(batch)
        pairs = tuple(map(state.inputs_of, indices))
        key = of_candidate(first, candidate)
        state.making.add((batch, candidate))
        return SceneJob(
            list(state.batches)[batch],
            key,
            pairs,
            contents=tuple(map(state.contents, indices)),
            recipe=request.recipe,
            source=self.store.source([key for pair in pairs for key in pair.points.values()]),
            matches=state.matches_of_candidate(batch, candidate),
            folder=None if request.scenes_dir is None else request.scenes_dir / key,
            cameras=request.cameras,
            candidate=candidate,
            scene=first,
        )

    # Answers

    def save(self, job: Job, answer: object, seconds: float) -> None:
        """Use an answer, and store it in one transaction."""
        self.state.release(job)
        if isinstance(job, MatchJob):
            self._save_points(job, cast(Sequence[PairMatch], answer))
        elif isinstance(job, EstimateJob):
            self._save_estimates(job, cast(Sequence[Estimated], answer))
        else:
            self._save_scene(job, cast(Solution, answer), seconds)
        # A full disk or a lock: the run continues, and the user may make room.
        if self.store.trouble:
            self.fault(self.store.trouble)

    def _save_points(self, job: MatchJob, answer: Sequence[PairMatch]) -> None:
        state = self.state
        rows = []
        for index, outcome in zip(job.indices, answer, strict=True):
            # An unreadable image stays unreadable in this run.
            if outcome.failure:
                state.note_unreadable(index, outcome.failure)
            for found in outcome.results:
                unit = state.number_of[found.unit.name]
                # Failures are not stored: the next run tries them again.
                if found.failure:
                    state.losses[index, unit] = RAISED
                    state.note_reason(index, found.unit.name, found.failure)
                    continue
                # In the recipe's order, as a crop's key has those of the points before it
                key = state.key(index, unit)
                state.losses[index, unit] = 0
                regions = (outcome.regions or ()) if found.unit.stage == 2 else ()
                rows.append(points_row(key, found, regions))
                state.use_points(index, unit, key, len(found.matches), is_needed=found.is_needed)
                # A unit that the pair does not need took no time.
                if found.is_needed:
                    self.costs.observe(found.unit.name, found.seconds, warm_up=found.warm_up)
                    self.units_run += 1
        self.store.put({"points": rows})

    def _save_estimates(self, job: EstimateJob, answer: Sequence[Estimated]) -> None:
        state = self.state
        rows = []
        for pair, found in zip(job.pairs, answer, strict=True):
            # Under the key of the points that the worker read, which may be older than the state's
            key = state.request.keys.of_estimate(found.points)
            facts = _estimate_facts(found)
            rows.append((key, json.dumps(facts)))
            state.losses[pair.index, ESTIMATE] = 0
            state.reasons.get(pair.index, {}).pop("estimate", None)
            state.use_estimate(pair.index, key, facts)
            self.costs.observe(COST_OF_ESTIMATES, found.seconds)
        self.store.put({"result": rows})
        self.estimated += len(answer)
        # While pairs are matched, the bar shows their units.
        if not state.is_matching:
            total = int(state.used[: state.rows].any(1).sum())
            done = total - int(state.lacks_estimate.sum())
            self._progress.count("estimate", done, total, "pair")

    def _save_scene(self, job: SceneJob, answer: Solution, seconds: float) -> None:
        record = SceneRecord.of(
            job.batch,
            answer.reconstructions,
            seconds=seconds,
            choices=dict(zip(job.contents, answer.choices, strict=True)),
            candidate=job.candidate,
            # Later digits vary between processors
            disagreement=float(f"{answer.disagreement:.6g}"),
            key=job.key,
        )
        self.store.put({"result": [(job.key, record.to_json())]})
        # The time of the loop, with the process's start: the forecast needs both.
        self.costs.observe_scene(job.matches, seconds)
        self.state.use_scene(self.state.batches[job.batch], record, job.scene)
        images = f"{record.registered} of {plural(record.images, 'image')} with a camera"
        text = f"batch {job.batch}: {images}{_by_tracks(job.candidate)}"
        # Other candidates are lines of the log.
        (self._say if job.candidate == ALL_UNITS else logger.debug)(text)
        if job.folder is not None:
            self._publish()  # tables of cameras should agree with COLMAP's files

    def _leave_out(self, answer: Loaded) -> None:
        """Continue without the matchers that could not be loaded, and say so once."""
        for name, reason in answer.refused.items():
            if name not in self.state.refused:
                self.warn(f"{name} is left out: {reason}")
        self.state.refuse(answer.refused)

    # Losses

    def lose(self, place: Place, job: Job | None, failure: Failure, now: float) -> None:
        """Record that a worker failed on a job, or could not start.

        Three rules distinguish a bad place, a bad unit and a bad pair:

        - A lost unit of a pair is tried once more, alone, and then given up in this run.
        - Only a job of pairs that were never lost counts against its place. Three in a row, without an answer in
          between, close it, and its losses are taken back. After a loss, it continues elsewhere in the order.
        - A unit that never ran is at fault itself when it was lost on more pairs than there are places. Where a
          place has answered, that does not count against the place.
        """
        if job is None:
            self.fault(f"{place.name}: {failure}")
            place.strikes += 1
        else:
            self.fault(f"a job was lost on {place.name}: {failure}")
            self._count_loss(place, job, failure)
        place.restart_at = now + RESTART_PAUSE_S * place.strikes
        # A refusal is an answer of the configuration, which no other worker would change.
        if place.strikes >= MAX_LOSSES or failure.cause is Cause.REFUSED:
            self._close(place, failure)

    def _count_loss(self, place: Place, job: Job, failure: Failure) -> None:
        state = self.state
        is_fresh = not state.has_losses(job)
        self._lose_job(job, str(failure))
        # A worker that reports an ordinary error works, and each scene has a process of its own.
        if failure.cause is Cause.RAISED or isinstance(job, SceneJob):
            place.note_answer()
            return
        blamed: list[int] = []
        is_match = isinstance(job, MatchJob)
        if isinstance(job, MatchJob) and not any(self.costs.mean(each.name) for each in job.units):
            blamed = state.columns_of(job)
        if is_fresh:
            self._blame(blamed, failure)
            place.strikes += not place.has_answered or (is_match and not blamed)
        elif is_match and not place.has_answered and self.site.has_other(place):
            place.strikes = MAX_LOSSES
        place.lost.append((job, blamed if is_fresh else []))

    def _blame(self, units: Sequence[int], failure: Failure) -> None:
        """Count a loss of units that never ran."""
        state = self.state
        for unit in units:
            state.unit_losses[unit] += 1
            if state.unit_losses[unit] == len(self.site.of(Kind.MATCH)) + 1:
                state.dead[unit] = True
                name = state.units[unit].name
                self.fault(f"{name} is skipped on all pairs: it never ran ({failure})")

    def _lose_job(self, job: Job, reason: str) -> None:
        """Count a lost job of its pairs, or of its scene."""
        self.state.release(job)
        if isinstance(job, SceneJob):
            self.fault(
                f"batch {job.batch} was not reconstructed{_by_tracks(job.candidate)}: {reason}"
            )
            self.state.lose_scene(self.state.batches[job.batch], job.candidate, reason)
        else:
            for index, name in self.state.lose(job, reason):
                logger.debug(f"{name} is skipped on pair {index} ({reason})")

    def _close(self, place: Place, failure: Failure) -> None:
        """Start no worker at a place any more, and take back its losses."""
        state = self.state
        place.closed = f"{place.name}: {failure}"
        again = f"; {plural(len(place.lost), 'lost job')} tried again" if place.lost else ""
        self.fault(f"no worker is started any more on {place.closed}{again}")
        for job, blamed in place.lost:
            state.take_back(job)
            state.unit_losses[blamed] -= 1
        state.dead = state.unit_losses > max(1, len(self.site.of(Kind.MATCH)))
        state.refuse({})
        if not self.site.of(Kind.SCENE):
            state.give_up_scenes(str(failure))

    def _fall_back(self) -> None:
        """Continue on the fallback places: all matching places are closed, or every unit is skipped."""
        reason = self.site.reason or Ending.NOTHING_RUNS
        self.warn(f"matching continues on the {self.site.fallback[0].name}: {reason}")
        self.site.fall_back()
        # Costs, losses and refusals say nothing about the other device.
        self.costs.forget()
        self.state.begin_anew()

    # Messages

    def fault(self, text: str) -> None:
        """Record a fault, once for each text: a broken disk would fill the log with them."""
        if text not in self.faults and len(self.faults) < MAX_FAULTS:
            self.faults.append(text)
            logger.debug(text)

    def warn(self, text: str) -> None:
        """Record a fault, and print it at once."""
        self.faults.append(text)
        logger.warning(text)

    def _say(self, text: str) -> None:
        self._progress.note(text)
        logger.debug(text)

    def _show(self, phase: int, fit: int) -> None:
        """Show the phase and the units that are done; a change of phase is a line of the log."""
        done = self.state.done[: self.state.rows]
        self._progress.count(PHASES[phase], int(done.sum()), done.size, "unit")
        text = PHASES[phase]
        # In other phases, the number of units that fit changes with each pair.
        if phase == DEEPEN:
            text = f"{text}: {fit} of {plural(len(self.state.units), 'unit')} fit for all pairs"
        if text != self._explained:
            self._explained = text
            logger.debug(text)

    # The end

    def _publish(self) -> None:
        if self._has_ended:
            self.publication.end(self.about)
        else:
            self.publication.publish(self.about)
        for text in (self.publication.unwritten, self.store.trouble):
            if text:
                self.fault(text)

    @property
    def about(self) -> About:
        """Facts about the run so far."""
        state = self.state
        return replace(
            state.request.about,
            ending=self.ending if self._has_ended else Ending.NOT_ENDED,
            seconds=self.budget.spent(),
            resumed=self.resumed,
            units_run=self.units_run,
            estimated=self.estimated,
            faults=self.faults,
            failures=list(state.scene_failures.values()),
            unwritten=self.publication.unwritten,
            unsaved=self.store.trouble,
        )

    @property
    def ending(self) -> Ending:
        state = self.state
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if state.dead.all():
            return Ending.NOTHING_RUNS
        if is_complete(state, self.crew):
            return Ending.WITH_FAILURES if state.has_failures else Ending.COMPLETE
        has_estimators = bool(self.site.of(Kind.ESTIMATE))
        return Ending.TIME_IS_UP if has_estimators and not self.site.is_closed else Ending.NO_WORKER

    def report(self) -> Results:
        """End the run. Return its results."""
        self.end()
        if unsaved := self.store.flush():  # the disk may have room again
            self.fault(unsaved)
        # Facts that a full disk kept from the store
        return replace(results_of(self.store), about=self.about)


def _by_tracks(candidate: str) -> str:
    return f" by the tracks of {title_of(candidate)}" if candidate != ALL_UNITS else ""


def _estimate_facts(found: Estimated) -> dict[str, object]:
    return {
        "F": found.F.ravel().tolist(),
        "failure": found.failure,
        "magsac": None if found.magsac is None else found.magsac.ravel().tolist(),
        "inliers": dict(zip(found.points, found.inliers, strict=True)),
        "support": found.stats.support,
    }
