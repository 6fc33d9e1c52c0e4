"""The engine: one loop on one thread. It gives jobs to workers, saves their answers, and publishes results."""

import os
import sqlite3
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from math import inf
from pathlib import Path
from typing import Any, Self

from mkpc_kaggle.data.images import content_digest
from mkpc_kaggle.engine import console
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.jobs import (
    Cause,
    EstimateJob,
    Failure,
    Job,
    Loaded,
    LookJob,
    MatchJob,
    SceneJob,
    WantedPair,
    visiting_order,
)
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.places import LISTEN_S, START_TIMEOUT_S, Place, Site, Work
from mkpc_kaggle.engine.plan import Plan
from mkpc_kaggle.engine.request import Chronicle, Ending, Request, RunReport, Standing
from mkpc_kaggle.engine.scenes import Scenes, batches_of, extra_pairs_of, standing_scenes
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.engine.tables import Estimates, Features, Key, Points, Table
from mkpc_kaggle.errors import UserError

UNKNOWN_SHARE, MAX_UNKNOWN_S = 0.25, 3600.0  # of the time left; a job of unknown cost that takes longer hangs
PUBLISH_INTERVAL_S, PUBLISH_SHARE = 30.0, 0.05  # between writes of the results; share of the time for writes
HASH_THREADS = 4

JOBS: dict[Work, tuple[type[Job], ...]] = {  # kinds of job for each kind of place, the most urgent first
    Work.MATCH: (MatchJob,),
    Work.LIGHT: (LookJob, EstimateJob),
    Work.SCENE: (SceneJob,),
}


class Engine:
    """A run. :meth:`look` and :meth:`ask` compute results that the journal does not have.

    ``nothing`` is the initial request, without pairs. Setting ``interrupt`` ends the run early.
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
        self.unwritten = ""
        self._chronicle = Chronicle(journal, budget, console.Progress(budget, sys.stderr if progress else None))
        self._until = inf
        self._published = budget.clock()
        self._publishing = threading.Lock()
        self._is_open = self._has_loaded = self._has_ended = False
        self._tables: dict[type[Job], Table] = {LookJob: Features(journal, {})}
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
        self._chronicle.progress.close()
        self._publish()
        self._has_ended = True

    # Requests

    def look(self, looks: Mapping[Key, Callable[[], bytes]]) -> dict[Key, bytes]:
        """Return the features by key (digest of contents, digest of settings). Failed ones are left out."""
        features = self._tables[LookJob] = Features(self.journal, looks)
        self._loop()
        self._tables[LookJob] = Features(self.journal, {})
        return features.found

    def ask(self, request: Request, share: float = 1.0) -> None:
        """Compute the missing results of a request. No job begins after ``share`` of the remaining time."""
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
            tuple(self._chronicle.faults),
            tuple(self._chronicle.explanations),
            self.unwritten,
            self.scenes.report(),
            self._chronicle.units_run,
            self._chronicle.estimated,
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
        recipe, settings, chronicle = request.recipe, request.settings, self._chronicle
        asked = [*request.pairs, *extra_pairs_of(request.pairs, recipe.scene)]
        pairs = [
            WantedPair(
                pair,
                (name_below(request.root, pair.file0), name_below(request.root, pair.file1)),
                settings.of_estimate(pair),
                number < len(request.pairs),
            )
            for number, pair in enumerate(asked)
        ]
        batches = batches_of(asked) if recipe.scene is not None else {}
        if is_asked:
            units = list(zip(recipe.units, settings.units, strict=True))
            self.journal.want(pairs, units, dict.fromkeys(batches, settings.scene), request.about)
        digests = self._digests(pairs)
        made, order = standing_scenes(self.journal, request), visiting_order(asked)
        self.state = State(self.journal, request, pairs, digests)
        explain, note = chronicle.explain, chronicle.progress.note
        self.plan = Plan(recipe.units, self.state, order, self.budget, explain, note, self.minibatch)
        self.estimates = Estimates(self.state, self.plan, order, chronicle)
        self.scenes = Scenes(batches, made, self.state, self.plan, self.estimates, chronicle)
        self._tables |= {
            MatchJob: Points(self.state, self.plan, chronicle),
            EstimateJob: self.estimates,
            SceneJob: self.scenes,
        }
        complete = self.state.had.all(1) & self.state.is_estimated
        self._resumed = int(complete[: self.state.rows].sum())

    def _digests(self, pairs: Sequence[WantedPair]) -> dict[str, str]:
        """Return the digests of images with points. Digest the files again, since new contents need new points."""
        files = {name: path for each in pairs for name, path in zip(each.names, each.pair.images, strict=True)}
        known = self.journal.digests()
        now = self.digest_files({name: path for name, path in files.items() if name in known})
        changed = {name: digest for name, digest in now.items() if known[name] != digest}
        for name, digest in changed.items():
            self.journal.save_digest(name, digest)
        if changed:
            count = sum(not changed.keys().isdisjoint(each.names) for each in pairs)
            text = f"{len(changed)} images have changed: their {count} pairs are matched again"
            console.warn(text)
            self._chronicle.fault(text)
        return known | changed

    # The loop

    def _loop(self) -> None:
        while not self._is_over(now := self.budget.clock()):
            for place in self.site.places:
                self._take_answer(place, now)
            self._fall_back()
            self._hand_out(now)
            places = self.site.places
            if not any(place.job or (place.is_starting and self._has_work(place, now)) for place in places):
                return
            if now - self._published > max(PUBLISH_INTERVAL_S, self.budget.writing / PUBLISH_SHARE):
                self._publish()
            limits = (place.limit for place in places)
            self.site.wait(min(self.budget.stop_waiting, *(limit for limit in limits if limit > now), inf))

    def _is_over(self, now: float) -> bool:
        return self.interrupt.is_set() or now >= self.budget.stop_waiting

    def _hand_out(self, now: float) -> None:
        """Start a worker in each place with work but no worker. Give a job to each idle worker."""
        if not self._is_open and self.plan.has_work(now):
            self.site.open()
            self._is_open = True
        estimates = self.estimates.reserve(now, len(self.site.of(Work.LIGHT)))
        self.plan.reserve = estimates + self.scenes.reserve()
        self.plan.workers = max(1, sum(not place.closed for place in self.site.of(Work.MATCH)))
        for place in self.site.places:
            if place.may_start(now) and self._has_work(place, now):
                share = max(self.budget.silence, self._unknown(now))
                place.start(now, START_TIMEOUT_S if place.work is Work.MATCH else min(START_TIMEOUT_S, share))
            elif place.is_idle and (job := self._next_job(place, now)) is not None:
                place.submit(job, self._time_limit(job, now), now)

    def _has_work(self, place: Place, now: float) -> bool:
        return now < self._until and any(self._tables[kind].has_work(now) for kind in JOBS[place.work])

    def _next_job(self, place: Place, now: float) -> Job | None:
        jobs = (self._tables[kind].next(now) for kind in JOBS[place.work] if now < self._until)
        return next((job for job in jobs if job is not None), None)

    def _time_limit(self, job: Job, now: float) -> float:
        """Return the seconds after which a worker counts as hung, from measured costs or from the time left."""
        patience = self._tables[type(job)].patience(job)
        return self.budget.silence + (self._unknown(now) if patience is None else patience)

    def _unknown(self, now: float) -> float:
        return min(MAX_UNKNOWN_S, UNKNOWN_SHARE * max(0.0, self.budget.stop_units - now))

    def _take_answer(self, place: Place, now: float) -> None:
        if place.job is not None:
            place.limit = place.since + self._time_limit(place.job, place.since)  # by the costs known now
        seconds = now - place.since
        answer, job = place.poll(now), place.job
        if isinstance(answer, Loaded):
            self._has_loaded = self._has_loaded or place.work is Work.MATCH
        elif isinstance(answer, Failure):
            place.job = None
            self._lose(place, job, answer)
        elif answer is not None and job is not None:
            place.job = None
            self._save(job, answer, seconds)
        if place.work is Work.SCENE and answer is not None and not isinstance(answer, Loaded):
            place.kill()

    def _save(self, job: Job, answer: Any, seconds: float) -> None:
        """Save an answer. If it cannot be saved, only this job fails."""
        table = self._tables[type(job)]
        try:
            table.save(job, answer, seconds)
        except sqlite3.Error as error:
            self._chronicle.fault(f"a result cannot be saved: {error}")
            table.lose(job, Failure(Cause.RAISED, str(error)))
        if trouble := self.journal.trouble:
            self._chronicle.fault(f"the journal cannot be written ({trouble}); it continues in memory")
        if isinstance(job, SceneJob) and job.export is not None:
            self._publish()

    def _lose(self, place: Place, job: Job | None, failure: Failure) -> None:
        """Record that a worker failed on a job, or could not start."""
        self._chronicle.fault(f"a job was lost on {place.name}: {failure}" if job else f"{place.name}: {failure}")
        if place.closed:
            self._chronicle.explain(f"no worker is started any more on {place.closed}")
        if job is not None:
            self._tables[type(job)].lose(job, failure)
        if place.closed and place.work is Work.SCENE:
            self.scenes.skip_all(failure)

    def _fall_back(self) -> None:
        """Continue on the fallback places once all matching places are closed, or every unit is skipped."""
        places = self.site.of(Work.MATCH)
        self.plan.is_closed = self._is_open and all(place.closed for place in places)
        reason = "; ".join(place.closed for place in places if place.closed)
        if self.site.fallback and (self.plan.is_closed or self.plan.nothing_runs):
            text = f"matching continues on the {self.site.fallback[0].name}: {reason or Ending.NOTHING_RUNS}"
            self._chronicle.fault(text)
            self._chronicle.explain(text)
            console.warn(text)
            for place in places:
                place.kill()
                self.site.places.remove(place)
            self.site.places += self.site.fallback
            self.site.fallback = []
            self.plan.restart()
        elif self.plan.is_closed and not self._has_loaded and places:
            raise UserError(f"no worker could be started: {reason}")

    # Results

    def save_results(self) -> str:
        """Write the results unless the run has ended. Return why that failed, or an empty text. Thread-safe."""
        with self._publishing:
            if not self._has_ended:
                try:
                    made, digests = dict(self.scenes.made), dict(self.state.digests)
                    self.state.request.publish(Standing(self.state.fundamentals, made, digests))
                    self.unwritten = ""
                except OSError as error:
                    self.unwritten = f"the results cannot be written: {error}"
        return self.unwritten

    def _publish(self) -> None:
        if not self.state.rows:
            return
        start = self.budget.clock()
        if trouble := self.save_results():
            self._chronicle.fault(trouble)
        self._published = self.budget.clock()
        self.budget.note_write(self._published - start)

    @property
    def ending(self) -> Ending:
        if self.interrupt.is_set():
            return Ending.INTERRUPTED
        if self.plan.nothing_runs:
            return Ending.NOTHING_RUNS
        now = self.budget.clock()
        if self.plan.is_complete and not self.estimates.has_work(now) and not self.scenes.waiting():
            return Ending.COMPLETE
        return Ending.NO_WORKER if self.plan.is_closed else Ending.TIME_IS_UP


def name_below(root: str, file: str) -> str:
    """Return a file's path relative to ``root``, or the whole path if the file lies elsewhere."""
    return file.removeprefix(root.rstrip(os.sep) + os.sep) if root else file
