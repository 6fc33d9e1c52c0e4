"""The engine: one loop on one thread. It gives jobs to workers, saves their answers, and publishes results."""

import os
import sqlite3
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from math import inf, isfinite
from pathlib import Path
from typing import Self, cast

from mkpc_kaggle.data.images import content_digest
from mkpc_kaggle.engine import console
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.estimates import EstimatePlan
from mkpc_kaggle.engine.jobs import (
    Answer,
    Cause,
    Estimated,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    LookJob,
    MatchJob,
    Outcome,
    PairPoints,
    PointSource,
    SceneJob,
    WantedPair,
    visiting_order,
)
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import Event, EventKind
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.places import LISTEN_S, START_TIMEOUT_S, Place, Site, Work
from mkpc_kaggle.engine.plan import HANG_FACTOR, Plan
from mkpc_kaggle.engine.records import SceneRecord
from mkpc_kaggle.engine.request import Ending, Request, RunReport, Standing
from mkpc_kaggle.engine.scenes import Scenes, batches_of, extra_pairs_of
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.reconstruct import Solution

UNKNOWN_SHARE, MAX_UNKNOWN_S = 0.25, 3600.0  # of the time left, after which a job of unknown cost hangs
MIN_TOLD_PAIRS = 20  # of a batch whose reconstruction is shown: that of a smaller batch takes seconds
PUBLISH_INTERVAL_S, PUBLISH_SHARE = 30.0, 0.05  # how often the results are written, and their share of the time
HASH_THREADS = 4


class Engine:
    """A run. :meth:`look` and :meth:`ask` compute what the journal does not have.

    ``nothing`` is a request without pairs, until the first is asked. Setting ``interrupt`` ends the run early.
    """

    def __init__(
        self,
        nothing: Request,
        site: Site,
        journal: Journal,
        budget: Budget,
        *,
        interrupt: threading.Event,
        progress: bool = True,
        minibatch: int = 1,
    ) -> None:
        self.site, self.journal, self.budget = site, journal, budget
        self.interrupt, self.minibatch = interrupt, minibatch
        self.faults: list[str] = []
        self.explanations: list[Event] = []
        self.unwritten = ""
        self.units_run = self.estimated = 0
        self.digests: dict[str, str] = {}
        self._looks: dict[tuple[str, str], LookJob] = {}
        self._features: dict[tuple[str, str], bytes] = {}
        self._look_losses: Losses[tuple[str, str]] = Losses()
        self._until = inf
        self._published = budget.clock()
        self._progress = console.Progress(budget, sys.stderr if progress else None)
        self._publishing = threading.Lock()
        self._is_open = self._has_loaded = self._has_ended = False
        self._begin(nothing)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End all workers, and publish for the last time."""
        if self._has_ended:
            return
        for place in [*self.site.places, *self.site.fallback]:
            place.kill()
        self.site.close()
        self._progress.close()
        self._publish()
        self._has_ended = True

    # Requests

    def look(
        self, looks: Mapping[tuple[str, str], Callable[[], bytes]], *, compute: bool = True
    ) -> dict[tuple[str, str], bytes]:
        """Return the features of each key (digest of contents, digest of settings), except failed ones.

        With ``compute = False``, return only features in the journal.
        """
        known = {key: self.journal.feature(*key) for key in looks}
        self._features = {key: value for key, value in known.items() if value is not None}
        if compute:
            self._looks = {key: LookJob(key, do) for key, do in looks.items() if key not in self._features}
            self._loop()
            self._looks.clear()
        return self._features

    def ask(self, request: Request, share: float = 1.0) -> None:
        """Compute the missing results of a request, in at most a share of the remaining time."""
        self._begin(request, is_asked=True)
        self._until = self.budget.clock() + share * self.budget.left() if share < 1 else inf
        self._publish()
        self._loop()

    def report(self) -> RunReport:
        """End the run. Return the results of the latest request."""
        self._end()
        return RunReport(
            tuple(self.journal.records()),
            self.ending,
            self.budget.spent(),
            self._resumed,
            tuple(self.faults),
            tuple(self.explanations),
            self.unwritten,
            self.scenes.report(),
            self.units_run,
            self.estimated,
        )

    def digest_files(self, files: Mapping[str, Path]) -> dict[str, str]:
        """Return the digest of each file's content by name; files that cannot be read are left out."""
        pool = ThreadPoolExecutor(HASH_THREADS)
        futures = {name: pool.submit(content_digest, path) for name, path in files.items()}
        pending = set(futures.values())
        while pending and not self._is_over(self.budget.clock()):
            _, pending = wait(pending, LISTEN_S)
        pool.shutdown(wait=False, cancel_futures=True)  # a file of many GB takes long
        done = {name: future for name, future in futures.items() if future.done() and not future.cancelled()}
        return {name: future.result() for name, future in done.items() if not future.exception()}

    def _begin(self, request: Request, *, is_asked: bool = False) -> None:
        """Find missing and outdated results. If ``is_asked``, record the request in the journal."""
        recipe, settings = request.recipe, request.settings
        self.request, self.recipe = request, recipe
        extra = extra_pairs_of(request.pairs, recipe.scene)
        self.pairs = [
            WantedPair(
                pair,
                (name_below(request.root, pair.file0), name_below(request.root, pair.file1)),
                settings.of_estimate(pair),
                number < len(request.pairs),
            )
            for number, pair in enumerate([*request.pairs, *extra])
        ]
        self._units = dict(zip((unit.name for unit in recipe.units), settings.units, strict=True))
        batches = batches_of(each.pair for each in self.pairs) if recipe.scene is not None else {}
        units = list(zip(recipe.units, settings.units, strict=True))
        if is_asked:
            self.journal.want(self.pairs, units, dict.fromkeys(batches, settings.scene), request.about)
        self._look_at_images()
        made = self.journal.scenes("scene") if request.exports else self.journal.scenes()
        for batch in request.exports.keys() & made.keys():
            if not request.exports[batch].has_files(made[batch].models):
                self.journal.forget_scene(batch)  # its files are a result, too
                del made[batch]
        self.state = State(self.journal, len(self.pairs), len(request.pairs), len(recipe.units))
        order = visiting_order([each.pair for each in self.pairs])
        note = self._progress.note
        self.plan = Plan(recipe.units, self.state, order, self.budget, self._explain, note, self.minibatch)
        self.scenes = Scenes(batches, made, self.journal.current_scenes())
        self.estimates = EstimatePlan(self.plan, order)
        complete = self.state.had.all(1) & self.state.is_estimated
        self._resumed = int(complete[: self.state.rows].sum())

    def _look_at_images(self) -> None:
        """Digest the images that have points again: points of other contents are out of date."""
        files = {
            name: path for each in self.pairs for name, path in zip(each.names, each.pair.images, strict=True)
        }
        known = self.journal.digests()
        now = self.digest_files({name: path for name, path in files.items() if name in known})
        changed = {name: digest for name, digest in now.items() if known[name] != digest}
        for name, digest in changed.items():
            self.journal.save_digest(name, digest)
        self.digests = known | changed
        if changed:
            count = sum(not changed.keys().isdisjoint(each.names) for each in self.pairs)
            text = f"{len(changed)} images have changed: their {count} pairs are matched again"
            console.warn(text)
            self._fault(text)

    # The loop

    def _loop(self) -> None:
        while not self._is_over(now := self.budget.clock()):
            for place in self.site.places:
                self._take_answer(place, now)
            self._fall_back(now)
            self._hand_out(now)
            if not any(place.job is not None or self._may_work(place, now) for place in self.site.places):
                return
            if now - self._published > max(PUBLISH_INTERVAL_S, self.budget.writing / PUBLISH_SHARE):
                self._publish()
            limits = (place.limit for place in self.site.places)
            self.site.wait(min(self.budget.stop_waiting, *(limit for limit in limits if limit > now), inf))

    def _is_over(self, now: float) -> bool:
        return self.interrupt.is_set() or now >= min(self._until, self.budget.stop_waiting)

    def _hand_out(self, now: float) -> None:
        """Start a worker in each place with work but no worker. Give a job to each idle worker."""
        if not self._is_open and self.plan.has_work(now):
            self.site.open()
            self._is_open = True
        estimates = self.estimates.reserve(now, len(self.site.of(Work.LIGHT)))
        self.plan.reserve = estimates + self.scenes.reserve(self.state.matches)
        self.plan.workers = max(1, sum(not place.closed for place in self.site.of(Work.MATCH)))
        for place in self.site.places:
            if place.may_start(now) and self._has_work(place.work, now):
                share = max(self.budget.silence, UNKNOWN_SHARE * self._left(now))
                place.start(now, START_TIMEOUT_S if place.work is Work.MATCH else min(START_TIMEOUT_S, share))
            elif place.is_idle and (job := self._next_job(place.work, now)) is not None:
                seconds = job.seconds if isinstance(job, MatchJob) else inf
                place.submit(job, seconds, self._time_limit(job, now), now)

    def _may_work(self, place: Place, now: float) -> bool:
        """Whether a place without a job will have one when a worker has started."""
        return place.is_starting and self._has_work(place.work, now)

    def _has_work(self, work: Work, now: float) -> bool:
        if work is Work.MATCH:
            return self.plan.has_work(now)
        if work is Work.LIGHT:
            return bool(self._looks) or bool(len(self.estimates.due(now)))
        return self._due_scene(now) is not None

    def _next_job(self, work: Work, now: float) -> Job | None:
        if work is Work.MATCH:
            job = self.plan.next(now)
            return job and self._with_pairs(job)
        if work is Work.SCENE:
            batch = self._due_scene(now)
            return None if batch is None else self._scene_job(batch)
        if self._looks:
            return self._looks.pop(next(iter(self._looks)))
        return self._estimate_job(now)

    def _time_limit(self, job: Job, now: float) -> float:
        """Return the seconds after which a worker hangs, from measured costs or from the time left."""
        patience = inf
        if isinstance(job, MatchJob):
            patience = self.plan.patience(job)
        elif isinstance(job, EstimateJob):
            patience = self.estimates.patience(job)
        unknown = min(MAX_UNKNOWN_S, UNKNOWN_SHARE * self._left(now))
        if isinstance(job, SceneJob):
            patience = max(unknown, HANG_FACTOR * self.scenes.forecast(job.matches))
        return self.budget.silence + (patience if isfinite(patience) else unknown)

    def _left(self, now: float) -> float:
        return max(0.0, self.budget.stop_units - now)

    # Matching

    def _with_pairs(self, job: MatchJob) -> MatchJob:
        """The job with its pairs, and with their points of stage 1 if critical regions are computed from them."""
        known: list[tuple[tuple[Unit, bytes], ...]] = []
        for index in job.indices:
            inputs = self.journal.inputs(index) if any(unit.stage == 2 for unit in job.units) else {}
            units = {unit.name: unit for unit in self.recipe.units if unit.stage == 1}
            revisions = {name: revision for name, revision in inputs.items() if name in units}
            blobs = self.journal.blobs(revisions.values())
            known.append(tuple((units[name], blobs[revision]) for name, revision in revisions.items()))
        upcoming = (path for index in self.plan.upcoming(job) for path in self.pairs[index].pair.images)
        pairs = tuple(self.pairs[index] for index in job.indices)
        return replace(job, pairs=pairs, known=tuple(known), upcoming=tuple(upcoming))

    def _take_matched(self, job: MatchJob, outcomes: Sequence[Outcome]) -> None:
        self.journal.save_outcomes(outcomes, self._units)
        self.units_run += sum(len(outcome.found) for outcome in outcomes)
        for outcome in outcomes:
            self.digests |= {image.name: image.digest for image in outcome.images}
        self.scenes.note_change(self.state.refresh(outcome.index for outcome in outcomes))
        self.plan.on_result(job, outcomes)
        seconds = sum(found.seconds for outcome in outcomes for found in outcome.found)
        self._note(EventKind.JOB, f"{job.phase} {len(job.indices)} pairs {seconds:.3f} s")
        self._progress.show(*self.plan.progress(self.budget.clock()))

    # Estimates

    def _estimate_job(self, now: float) -> EstimateJob | None:
        chosen, is_retry = self.estimates.next(now)
        pairs = tuple(self._pair_points(index) for index in chosen)
        return EstimateJob(pairs, self.recipe, self._source(pairs), is_retry) if pairs else None

    def _take_estimates(self, estimates: Sequence[Estimated]) -> None:
        self.journal.save_estimates(estimates)
        self.estimated += len(estimates)
        self.scenes.note_change(self.state.refresh(self.estimates.on_result(estimates)))
        if not self.plan.busy.any():
            rows = slice(self.state.rows)
            done, total = self.state.is_estimated[rows].sum(), self.state.had[rows].any(1).sum()
            self._progress.show("estimate", int(done), int(total))

    def _pair_points(self, index: int) -> PairPoints:
        """The current points of a pair, for an estimate or a scene."""
        inputs, units = self.journal.inputs(index), {unit.name: unit for unit in self.recipe.units}
        images = self.journal.images(index)
        own = self.state.own[index] if self.state.has_own[index] else None
        points = tuple((units[name], revision) for name, revision in inputs.items())
        return PairPoints(index, (images[0], images[1]), points, self.pairs[index].pair.intrinsics, own)

    def _source(self, pairs: Sequence[PairPoints]) -> PointSource:
        """Workers read points themselves, unless the journal is in memory."""
        revisions = [revision for pair in pairs for revision in pair.revisions]
        blobs = self.journal.blobs(revisions) if self.journal.is_in_memory else None
        return PointSource(self.journal.path.parent, blobs)

    # Scenes

    def _due_scene(self, now: float) -> str | None:
        """Return a batch to reconstruct now: its pairs have what fits; any batch if matching has ended."""
        if not (waiting := self.scenes.waiting(self.state.matches)):
            return None
        pending = self.estimates.busy.copy()
        pending[self.estimates.due(now)] = True
        if self._is_matching(now):
            settled, filled = self.plan.settled(now) & ~pending, self.plan.filled(now) & ~pending
            return self.scenes.due(self.state.matches, settled, filled)
        is_late = now >= self.plan.stop  # too late to wait for estimates
        return next((name for name in waiting if is_late or not pending[self.scenes.batches[name]].any()), None)

    def _is_matching(self, now: float) -> bool:
        places = self.site.of(Work.MATCH)
        is_closed = self._is_open and all(place.closed for place in places)
        return any(place.job is not None for place in places) or (self.plan.has_work(now) and not is_closed)

    def _scene_job(self, batch: str) -> SceneJob:
        self.scenes.running.add(batch)
        members = [index for index in self.scenes.batches[batch] if self.state.had[index].any()]
        pairs = tuple(self._pair_points(index) for index in members)
        if len(pairs) >= MIN_TOLD_PAIRS:
            self._progress.note(f"batch {batch}: reconstructing its cameras from {len(pairs)} pairs")
        inputs, matches = self.journal.batch_inputs(batch), int(self.state.matches[members].sum())
        return SceneJob(
            batch, pairs, self.recipe, self._source(pairs), inputs, matches, self.request.exports.get(batch)
        )

    def _take_scene(self, job: SceneJob, answer: Solution, seconds: float) -> None:
        record = SceneRecord.of(job.batch, answer.reconstructions, seconds)
        if job.export is not None:
            self.journal.forget_scene(job.batch)  # its files are replaced
        self.journal.save_scene(record, job.inputs, job.pairs, answer.choices)
        self.scenes.on_result(job, record, is_current=self.journal.batch_inputs(job.batch) == job.inputs)
        self.state.read_choices()
        text = f"{record.registered} of {record.images} images"
        self._note(EventKind.SCENE, f"{record.batch}: {text}")
        if len(job.pairs) >= MIN_TOLD_PAIRS:
            self._progress.note(f"batch {job.batch}: {text} have a camera")
        if job.export is not None:
            self._publish()

    # Answers

    def _take_answer(self, place: Place, now: float) -> None:
        if place.job is not None:
            place.limit = place.since + self._time_limit(place.job, place.since)  # by the costs known now
        seconds = now - place.since
        answer, job = place.poll(now), place.job
        if isinstance(answer, Loaded):
            self._has_loaded = self._has_loaded or place.work is Work.MATCH
        elif answer is not None:
            place.job = None
            if isinstance(answer, Failure):
                self._fault(f"a job was lost on {place.name}: {answer}" if job else f"{place.name}: {answer}")
                if place.closed:
                    self._explain(f"no worker is started any more on {place.closed}")
                self._lose(job, answer)
                if place.closed and place.work is Work.SCENE:
                    self.scenes.skip_all(answer)
            else:
                self._save(job, answer, seconds)
            if place.work is Work.SCENE:
                place.kill()

    def _save(self, job: Job | None, answer: Answer, seconds: float) -> None:
        """Take an answer. A result that no table can hold costs itself alone."""
        try:
            if isinstance(job, MatchJob):
                self._take_matched(job, cast(Sequence[Outcome], answer))
            elif isinstance(job, EstimateJob):
                self._take_estimates(cast(Sequence[Estimated], answer))
            elif isinstance(job, SceneJob) and isinstance(answer, Solution):
                self._take_scene(job, answer, seconds)
            elif isinstance(job, LookJob) and isinstance(answer, bytes):
                self._features[job.key] = answer
                self.journal.save_feature(*job.key, answer)
        except sqlite3.Error as error:
            self._fault(f"a result cannot be saved: {error}")
            self._lose(job, Failure(Cause.RAISED, str(error)))
        if self.journal.trouble:
            self._fault(f"the journal cannot be written ({self.journal.trouble}); it continues in memory")

    def _lose(self, job: Job | None, failure: Failure) -> None:
        if isinstance(job, MatchJob):
            self.plan.on_failure(job, failure)
        elif isinstance(job, EstimateJob):
            if self.estimates.on_failure(job, failure):
                self._explain(f"pair {job.pairs[0].index} keeps the F it has: {failure}")
        elif isinstance(job, SceneJob):
            self._fault(f"batch {job.batch} was not reconstructed: {failure}")
            self.scenes.on_failure(job, failure)
        elif isinstance(job, LookJob) and not self._look_losses.add([job.key], failure):
            self._looks[job.key] = job

    def _fall_back(self, now: float) -> None:
        """Continue elsewhere when the last matching place is closed, or had to skip every unit."""
        places = self.site.of(Work.MATCH)
        is_closed = self._is_open and all(place.closed for place in places)
        reason = "; ".join(place.closed for place in places if place.closed)
        if self.site.fallback and (is_closed or self.plan.nothing_runs):
            text = f"matching continues on the {self.site.fallback[0].name}: {reason or Ending.NOTHING_RUNS}"
            self._fault(text)
            console.warn(text)
            for place in places:
                place.kill()
                self.site.places.remove(place)
            self.site.places += self.site.fallback
            self.site.fallback = []
            self._explain(text)
            self.plan.busy[:] = False
            self.plan.restart()
        elif is_closed and not self._has_loaded and places:
            raise UserError(f"no worker could be started: {reason}")

    # Results

    def save_results(self) -> str:
        """Write the results unless the run has ended. Return why they cannot be written. For any thread."""
        with self._publishing:
            if not self._has_ended:
                try:
                    made = dict(self.scenes.made)
                    self.request.publish(Standing(self.state.fundamentals, made, dict(self.digests)))
                    self.unwritten = ""
                except OSError as error:
                    self.unwritten = f"the results cannot be written: {error}"
        return self.unwritten

    def _publish(self) -> None:
        if not self.request.pairs:
            return
        start = self.budget.clock()
        if trouble := self.save_results():
            self._fault(trouble)
        self._published = self.budget.clock()
        self.budget.note_write(self._published - start)

    def _explain(self, text: str) -> None:
        self.explanations.append(self._note(EventKind.PLAN, text))

    def _note(self, kind: EventKind, text: str) -> Event:
        event = Event(kind, self.budget.spent(), text)
        with suppress(sqlite3.Error):
            self.journal.note(event)
        return event

    def _fault(self, what: str) -> None:
        if what not in self.faults:
            self.faults.append(what)
            self._note(EventKind.FAULT, what)

    @property
    def ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if self.plan.nothing_runs:
            return Ending.NOTHING_RUNS
        if (
            self.plan.is_complete
            and not len(self.estimates.due(self.budget.clock()))
            and not self.scenes.waiting(self.state.matches)
        ):
            return Ending.COMPLETE
        places = self.site.of(Work.MATCH)
        return Ending.NO_WORKER if places and all(place.closed for place in places) else Ending.TIME_IS_UP


def name_below(root: str, file: str) -> str:
    """Return the name of a file below ``root``; a file elsewhere goes by its path."""
    return file.removeprefix(root.rstrip(os.sep) + os.sep) if root else file
