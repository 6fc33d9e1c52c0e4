"""The loop of a run, on one thread: give jobs to idle workers, take their answers, publish.

:func:`mkpc_kaggle.engine.plan.plan` decides which pairs, estimates and scenes come next.
"""

import json
import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Self

import numpy as np

from mkpc_kaggle.engine import budget as times
from mkpc_kaggle.engine.budget import Budget, Costs, start_limit, time_limit
from mkpc_kaggle.engine.console import Event, EventKind, Progress, append_event, logger
from mkpc_kaggle.engine.frames import results_of
from mkpc_kaggle.engine.keys import of_candidate
from mkpc_kaggle.engine.places import Kind, Lost, Place, Site
from mkpc_kaggle.engine.plan import Crew, MatchPlan, NextWork, is_complete, outlook, plan
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
    PairInputs,
    RunReport,
    SceneJob,
)
from mkpc_kaggle.engine.state import DEEPEN, ESTIMATE, NEVER, PHASES, RAISED, SWEEP, State
from mkpc_kaggle.engine.store import Store, points_row
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.scene.candidates import ALL_UNITS, title_of
from mkpc_kaggle.scene.records import SceneRecord
from mkpc_kaggle.scene.sfm import Solution

# Pairs of a job of estimates. More would make the last F of a run wait for each other; single pairs, each with a
# message and a transaction, would cost the loop more.
MAX_ESTIMATES = 8
MAX_LOSSES = 3  # of a place in a row, without an answer in between
RESTART_PAUSE_S = (
    1.0  # times the losses of a place in a row: scarce memory may become free meanwhile
)
# Faults of a run with different texts, and its decisions. The number of units that fit may change with
# each job, for hours.
MAX_FAULTS, MAX_PLANS = 1000, 10_000


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
        self.site = site
        self.store = store
        self.budget = budget
        self.interrupt = interrupt
        # By this run's answers alone: another machine may have computed the stored results.
        self.costs = Costs()
        self.faults: list[str] = []
        self.plans: list[Event] = []
        self.units_run = self.estimated = 0
        self._progress = Progress(budget.left, is_shown=progress)
        self._explained = ""  # the phase that was explained last
        self._is_announced = False  # the outlook, once all costs were measured
        self._has_loaded = False  # some worker of matching was ready
        self._has_ended = False
        self.note(EventKind.START)
        # For the report: an interrupted program has two seconds for it, and the import takes one.
        import_module("pandas")
        self.state = state
        self.resumed = int(state.complete.sum())
        self.publication = Publication(state, store, budget)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.end()
        # Reports call a session without this event "not ended".
        if kind is None:
            self.note(EventKind.END, self.ending)

    def end(self) -> None:
        """End all workers, and publish for the last time."""
        if not self._has_ended:  # report() and leaving the context both end the run
            self._has_ended = True
            self.site.close()
            self._progress.close()
            self._publish(is_last=True)

    # The loop

    def run(self) -> None:
        if self.resumed:
            pairs = plural(self.state.rows, "pair")
            self._progress.note(f"{self.resumed} of {pairs} from earlier runs")
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
            if work.match is not None and not self.site.is_open:
                # A finished run joins no cluster and starts no worker of matching.
                self.site.open()
            for place in self.site.free(now):
                self._give(place, work, now)
            if not (work.match or work.estimates or work.scenes or self.site.has_jobs):
                break
            if self.publication.is_due(now):
                self._publish()
            self.site.wait(self.budget.stop_waiting)
        if self.site.is_closed and not self._has_loaded:
            raise UserError(f"no worker could be started: {self.site.reason}")

    def _take(self, place: Place, answer: Answer, now: float) -> None:
        job, place.job = place.job, None
        if isinstance(answer, Failure):
            self.lose(place, job, answer, now)
        elif job is None:
            self._note_loaded(place, answer)
        else:
            place.note_answer()
            self.save(job, answer, now - place.since)
        if job is not None and place.kind is Kind.SCENE:
            place.kill()  # pycolmap's memory does not return

    def _seconds_of(self, place: Place) -> float:
        """Return how long the worker of a place may start, or compute its job, by the costs known now."""
        if place.job is not None:
            return time_limit(place.job, self.costs, self.budget, place.since)
        loads_matchers = place.kind is Kind.MATCH
        return start_limit(self.budget, place.since, loads_matchers=loads_matchers)

    def is_over(self) -> bool:
        return self.interrupt.is_set() or self.budget.clock() >= self.budget.stop_waiting

    def plan(self, now: float, lost: int = 0) -> NextWork:
        return plan(self.state, self.costs, self.budget, self.crew, now, lost)

    @property
    def crew(self) -> Crew:
        """The workers that exist now, without places that are closed."""
        site = self.site
        matchers = site.of(Kind.MATCH)
        # Before the places are open, one is assumed. All have the same kind of device.
        minibatch = max((place.minibatch for place in matchers), default=1)
        count = len(matchers) if site.is_open else 1
        return Crew(count, len(site.of(Kind.ESTIMATE)), len(site.of(Kind.SCENE)), minibatch)

    def _publish(self, *, is_last: bool = False) -> None:
        if is_last:
            self.publication.end()
        else:
            self.publication.publish()
        for text in (self.publication.unwritten, self.store.trouble):
            if text:
                self.fault(text)

    # Handing out

    def _give(self, place: Place, work: NextWork, now: float) -> None:
        """Give a job to a free place, or start a worker there if there is one to give."""
        if place.kind is Kind.MATCH:
            # Again for each place: the former one's job has changed what is next.
            work = self.plan(now, len(place.lost))
            self._explain(work, now)
            if not place.is_idle:
                if work.match is not None:
                    place.start(now)
            elif work.match is not None:
                self._give_pairs(place, work.match, now)
        elif place.kind is Kind.ESTIMATE and work.estimates:
            if place.is_idle:
                self._give_estimates(place, work.estimates, now)
            else:
                place.start(now)
        elif place.kind is Kind.SCENE and len(work.scenes) > 0:
            if place.is_idle:
                self._give_scene(place, work.scenes.pop(0), now)
            elif self._has_room_for_scene(work):
                place.start(now)

    def _has_room_for_scene(self, work: NextWork) -> bool:
        """Return whether another process may start: there is a scene for it, and a core."""
        places = self.site.of(Kind.SCENE)
        starting = sum(place.is_starting for place in places)
        # While matching uses the other cores, scenes have only the cores that it leaves free.
        is_matching = work.match is not None or self._is_matching
        most = self.site.scenes_at_a_time(is_matching=is_matching)
        busy = starting + sum(place.job is not None for place in places)
        return starting < len(work.scenes) and busy < most

    @property
    def _is_matching(self) -> bool:
        return bool((self.state.busy < NEVER).any())

    def _give_pairs(self, place: Place, chosen: MatchPlan, now: float) -> None:
        state = self.state
        crops = [number for number in chosen.units if state.is_crop[number]]
        # The points that the last crop comes from; the worker leaves out those after an earlier one.
        inputs = [self._points_before(index, max(crops, default=0)) for index in chosen.pairs]
        digests = []
        for index in chosen.pairs:
            digests.append(tuple(image.digest for image in state.images_of(index)))
        job = MatchJob(
            chosen.pairs,
            [state.units[number] for number in chosen.units],
            chosen.expected,
            chosen.seconds,
            [state.pairs[index] for index in chosen.pairs],
            digests,
            upcoming=[path for index in chosen.upcoming for path in state.pairs[index].images],
        )
        keys = [key for pair in inputs for key in pair.values()] if crops else []
        try:
            points = self.store.source(keys).matches(keys)
        except (UserError, sqlite3.Error, KeyError) as error:  # a disk that fails costs the job
            self._lose_job(job, f"the store cannot be read: {error}")
            return
        if crops:
            given = [
                tuple(UnitResult(state.units[number], points[key]) for number, key in pair.items())
                for pair in inputs
            ]
            job = replace(job, given=given)
        state.busy[chosen.pairs] = chosen.phase
        place.submit(job, now)

    def _points_before(self, index: int, unit: int) -> dict[int, str]:
        """Return the keys of a pair's points of stage 1 before a unit, by the number of their unit."""
        state = self.state
        chosen = np.flatnonzero(state.done[index, :unit] & ~state.is_crop[:unit]).tolist()
        return {number: state.points[index, number].decode() for number in chosen}

    def _give_estimates(self, place: Place, due: list[int], now: float) -> None:
        """Give the first pairs that are due; one with a lost job is alone."""
        losses = self.state.losses[:, ESTIMATE]
        fresh = [index for index in due[:MAX_ESTIMATES] if not losses[index]]
        chosen = fresh or due[:1]
        due[:] = [index for index in due if index not in chosen]
        self.state.estimating[chosen] = True
        place.submit(self._estimate_job(chosen), now)

    def _estimate_job(self, indices: Sequence[int]) -> EstimateJob:
        pairs = tuple(map(self.state.inputs_of, indices))
        source = self.store.source(_keys_of(pairs))
        return EstimateJob(pairs, self.state.request.recipe, source)

    def _give_scene(self, place: Place, due: tuple[int, str], now: float) -> None:
        """Give a batch's candidate, from the results in use now.

        If its pairs get other results meanwhile, the scene is stale when it arrives.
        """
        state = self.state
        batch, candidate = due
        request = state.request
        indices, first = state.scene_inputs(batch)
        pairs = tuple(map(state.inputs_of, indices))
        key = of_candidate(first, candidate)
        name = list(state.batches)[batch]
        job = SceneJob(
            name,
            key,
            pairs,
            contents=tuple(map(state.contents, indices)),
            recipe=request.recipe,
            source=self.store.source(_keys_of(pairs)),
            matches=state.matches_of_candidate(batch, candidate),
            folder=None if request.scenes_dir is None else request.scenes_dir / key,
            cameras=request.cameras,
            candidate=candidate,
            scene=first,
        )
        # Other candidates are lines of the log.
        if candidate == ALL_UNITS:
            about = format_duration(self.costs.scene(job.matches))
            text = f"reconstructing its cameras from {plural(len(pairs), 'pair')}, about {about}"
            self._progress.note(f"batch {name}: {text}")
        state.making.add(due)
        place.submit(job, now)

    # Answers

    def save(self, job: Job, answer: object, seconds: float) -> None:
        """Save an answer, first in the store, then in the state: results in the state are never lost."""
        if isinstance(job, MatchJob):
            assert isinstance(answer, tuple)
            self._save_points(job, answer)
        elif isinstance(job, EstimateJob):
            assert isinstance(answer, tuple)
            self._save_estimates(job, answer)
        else:
            assert isinstance(answer, Solution)
            self._save_scene(job, answer, seconds)
        # A full disk or a lock: the run continues, and the user may make room.
        if self.store.trouble:
            self.fault(self.store.trouble)

    def _save_points(self, job: MatchJob, answer: Sequence[PairMatch]) -> None:
        state = self.state
        rows = []
        for index, outcome in zip(job.indices, answer, strict=True):
            state.busy[index] = NEVER
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
            state.estimating[pair.index] = False
            # Under the key of the points that the worker read, which may be older than the state's
            key = state.request.keys.of_estimate(found.points)
            facts = _estimate_facts(found)
            rows.append((key, json.dumps(facts)))
            state.losses[pair.index, ESTIMATE] = 0
            state.reasons.get(pair.index, {}).pop("estimate", None)
            state.use_estimate(pair.index, key, facts)
            self.costs.observe(times.COST_OF_ESTIMATES, found.seconds)
        self.store.put({"result": rows})
        self.estimated += len(answer)
        # While pairs are matched, the bar shows those.
        if not (state.busy < NEVER).any():
            total = int(state.used[: state.rows].any(1).sum())
            self._progress.count("estimate", total - int(state.lacks_estimate.sum()), total)

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
        batch = self.state.batches[job.batch]
        self.state.making.discard((batch, job.candidate))
        is_best = self.state.use_scene(batch, record, job.scene)
        text = f"{record.registered} of {plural(record.images, 'image')}"
        if job.candidate == ALL_UNITS:
            self._progress.note(f"batch {job.batch}: {text} with a camera")
        else:
            text += _by_tracks(job.candidate)
            text += ", the best so far" if is_best else ", not better"
        self.note(EventKind.SCENE, f"{job.batch}: {text}")
        if job.folder is not None:
            self._publish()  # tables of cameras should agree with COLMAP's files

    def _note_loaded(self, place: Place, answer: object) -> None:
        """Continue without the matchers that could not be loaded, and say so once."""
        assert isinstance(answer, Loaded)
        self._has_loaded = self._has_loaded or place.kind is Kind.MATCH
        for name, reason in answer.refused.items():
            if name not in self.state.refused:
                text = f"{name} is left out: {reason}"
                self.explain(text)
                self.warning(text)
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
        units: list[int] = []
        is_fresh = new = False
        if isinstance(job, MatchJob):
            units = [state.number_of[unit.name] for unit in job.units]
            is_fresh = not state.losses[list(job.indices), :-1].any()
            new = not any(self.costs.mean(unit.name) for unit in job.units)
        elif isinstance(job, EstimateJob):
            is_fresh = not state.losses[job.indices, ESTIMATE].any()
        self._lose_job(job, str(failure))
        # A worker that reports an ordinary error works, and each scene has a process of its own.
        if failure.cause is Cause.RAISED or isinstance(job, SceneJob):
            place.note_answer()
            return
        place.lost.append(Lost(list(job.indices), units, blamed=units if is_fresh and new else []))
        if is_fresh:
            place.strikes += not place.has_answered or not (new or place.kind is Kind.ESTIMATE)
            self._blame(place.lost[-1].blamed, failure)
        elif place.kind is Kind.MATCH and not place.has_answered and self.site.has_other(place):
            place.strikes = MAX_LOSSES

    def _blame(self, units: Sequence[int], failure: Failure) -> None:
        """Count a loss of units that never ran."""
        state = self.state
        for unit in units:
            state.unit_losses[unit] += 1
            if state.unit_losses[unit] == len(self.site.of(Kind.MATCH)) + 1:
                state.dead[unit] = True
                name = state.units[unit].name
                self.explain(f"{name} is skipped on all pairs: it never ran ({failure})")

    def _lose_job(self, job: Job, reason: str) -> None:
        """Count a lost job of its pairs, or of its scene."""
        state = self.state
        if isinstance(job, MatchJob):
            indices = list(job.indices)
            state.busy[indices] = NEVER
            units = [state.number_of[unit.name] for unit in job.units]
            for index, unit in state.lose_units(indices, units, reason):
                self.explain(f"{state.units[unit].name} is skipped on pair {index} ({reason})")
        elif isinstance(job, EstimateJob):
            state.estimating[job.indices] = False
            for index, _ in state.lose_units(job.indices, [ESTIMATE], reason):
                self.explain(f"pair {index} keeps the F it has: {reason}")
        else:
            tracks = _by_tracks(job.candidate)
            self.fault(f"batch {job.batch} was not reconstructed{tracks}: {reason}")
            batch = state.batches[job.batch]
            state.making.discard((batch, job.candidate))
            state.lose_scene(batch, job.candidate, reason)

    def _close(self, place: Place, failure: Failure) -> None:
        """Start no worker at a place any more, and take back its losses."""
        state = self.state
        place.closed = f"{place.name}: {failure}"
        self.explain(f"no worker is started any more on {place.closed}")
        for lost in place.lost:
            state.take_back(lost.indices, lost.units or [ESTIMATE])
            state.unit_losses[lost.blamed] -= 1
        state.dead = state.unit_losses > max(1, len(self.site.of(Kind.MATCH)))
        state.refuse({})
        if not self.site.of(Kind.SCENE):
            state.give_up_scenes(str(failure))
        if place.lost:
            count = plural(len(place.lost), "lost job")
            self.explain(f"{count} of {place.name} will be tried again elsewhere")

    def _fall_back(self) -> None:
        """Continue on the fallback places: all matching places are closed, or every unit is skipped."""
        text = f"matching continues on the {self.site.fallback[0].name}: "
        text += self.site.reason or Ending.NOTHING_RUNS
        self.warning(text)
        self.explain(text)
        self.site.fall_back()
        # Costs, losses and refusals say nothing about the other device.
        self.costs.forget()
        self.state.begin_anew()
        self._explained = ""

    # Messages

    def note(self, kind: EventKind, text: str = "") -> Event:
        event = Event(self.budget.spent(), kind, text)
        append_event(self.store.directory, event)
        return event

    def explain(self, text: str) -> None:
        """Record a decision."""
        if len(self.plans) < MAX_PLANS:
            self.plans.append(self.note(EventKind.PLAN, text))

    def fault(self, text: str) -> None:
        """Record a fault, once for each text: a broken disk would fill the log with them."""
        if text not in self.faults and len(self.faults) < MAX_FAULTS:
            self.faults.append(text)
            self.note(EventKind.FAULT, text)

    def warning(self, text: str) -> None:
        """Record a fault, and print it at once."""
        self.fault(text)
        logger.warning(text)

    def _explain(self, work: NextWork, now: float) -> None:
        """Show the phase, and explain a change of it or of the units that fit. Announce the outlook once it is
        measured.
        """
        if work.match is None:
            return
        phase = PHASES[work.phase]
        self._progress.count(phase, work.done, work.total)
        # During the sweep, only one cost is measured.
        if work.phase == SWEEP:
            return
        # In other phases, the number of units that fit changes with each pair.
        fitting = f"{phase} {work.fit if work.phase == DEEPEN else ''}"
        if fitting == self._explained and self._is_announced:
            return
        # Nothing is announced before it is measured.
        text = outlook(self.state, self.costs, self.budget, self.crew, now)
        if not text:
            fitting = f"{phase}, unmeasured"
        if fitting != self._explained:
            self.explain(f"{phase}: {text or 'not all units were measured yet'}")
            self._explained = fitting
        if text and not self._is_announced:
            self._progress.note(text)
            self._is_announced = True

    # The end

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

    def report(self) -> RunReport:
        """End the run. Return its results."""
        self.end()
        unsaved = self.store.flush()  # the disk may have room again
        if unsaved:
            self.fault(unsaved)
        return RunReport(
            tables=results_of(self.store),
            ending=self.ending,
            seconds=self.budget.spent(),
            resumed=self.resumed,
            faults=tuple(self.faults),
            explanations=tuple(self.plans),
            unwritten=self.publication.unwritten,
            unsaved=unsaved,
            units_run=self.units_run,
            estimated=self.estimated,
        )


def _keys_of(pairs: Sequence[PairInputs]) -> list[str]:
    return [key for pair in pairs for key in pair.points.values()]


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
