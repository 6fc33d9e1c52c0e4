"""The loop of a run, on one thread. It gives jobs to workers, saves their answers, and publishes
results.
"""

import sqlite3
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, replace
from math import inf
from pathlib import Path
from secrets import token_hex
from typing import Any, Self

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import content_digest
from mkpc_kaggle.engine import console
from mkpc_kaggle.engine.budget import ESTIMATE, Budget, Costs
from mkpc_kaggle.engine.jobs import (
    Answer,
    Cause,
    EstimateJob,
    Failure,
    FeatureJob,
    Found,
    Job,
    Loaded,
    MatchJob,
    Outcome,
    Phase,
    SceneJob,
    Tries,
)
from mkpc_kaggle.engine.places import LISTEN_S, START_TIMEOUT_S, Place, Site, Work
from mkpc_kaggle.engine.records import (
    IMAGE,
    NOT_RECONSTRUCTED,
    Event,
    EventKind,
    SceneRecord,
    file_result,
    read_records,
)
from mkpc_kaggle.engine.request import Ending, Request, RunReport
from mkpc_kaggle.engine.schedule import (
    Crew,
    NextWork,
    estimate_patience,
    is_complete,
    lacking_estimates,
    match_patience,
    next_work,
    outlook,
    scene_patience,
    upcoming_pairs,
)
from mkpc_kaggle.engine.state import EXPORT, State
from mkpc_kaggle.engine.store import Kind, Result, Store, from_bytes
from mkpc_kaggle.engine.worker import file_state
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs

# Of the time left; a job of unknown cost that takes longer hangs.
UNKNOWN_SHARE = 0.25
MAX_UNKNOWN_S = 3600.0
PUBLISH_INTERVAL_S = 30.0  # between writes of the results
PUBLISH_SHARE = 0.05  # maximum share of the time for writes
HASH_THREADS = 4
MAX_FAILED_PAIRS = 2  # a unit that was given up on this many pairs and never ran is skipped on all
MAX_ESTIMATES = 8  # pairs in a job of estimates
MIN_PAIRS = 2  # the minimum to connect three images


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
        minibatch: int = 1,
    ) -> None:
        self.site = site
        self.store = store
        self.budget = budget
        self.interrupt = interrupt
        self.minibatch = minibatch
        self.state: State | None = None  # until something is asked for
        # By this run's answers: another machine may have made those of the store
        self.costs = Costs()
        self.unwritten = ""
        self.faults: list[str] = []
        self.explanations: list[Event] = []
        self.units_run = 0
        self.estimated = 0
        self._progress = console.Progress(budget, sys.stderr if progress else None)
        self._tries = Tries()  # of features; those of pairs are in the state
        self._features: dict[str, FeatureJob] = {}  # to compute
        self._found: dict[str, Any] = {}
        self._refused: dict[str, str] = {}  # why a matcher cannot be loaded, by name
        self._until = inf  # no job begins after this time, which is the end of a trial
        self._published = budget.clock()
        self._publishing = threading.Lock()  # the watchdog publishes, too
        self._is_open = self._has_loaded = self._has_ended = self._is_announced = False
        self._explained = ""  # the phase that was explained last
        self._shown: NextWork | None = None  # the phase of the bar, with its number of pairs
        self._resumed = 0  # rows that earlier runs finished

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End all workers, and publish for the last time."""
        if self._has_ended:
            return
        # First, because a worker that writes COLMAP's files must not do so after the last version.
        for place in [*self.site.places, *self.site.fallback]:
            place.kill()
        self.site.close()
        self._progress.close()
        self._publish()
        self._has_ended = True

    # Requests

    def known(self, key: str) -> Any:
        """Return the stored features with this key, a JSON value; ``None`` if there are none."""
        return self.store.about([key]).get(key)

    def look(self, jobs: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
        """Return features by key: JSON values, or bytes. Failed ones are left out."""
        about = self.store.about(jobs)
        # What is no JSON value is data.
        data = self.store.data(key for key in about if about[key] is None)
        self._found = {**about, **data}
        self._features = {
            key: FeatureJob(key, do) for key, do in jobs.items() if key not in self._found
        }
        self._loop()
        self._features = {}
        return self._found

    def ask(self, request: Request, share: float = 1.0) -> None:
        """Compute the missing results of a request. No job begins after ``share`` of the remaining
        time.
        """
        config = request.recipe.scene
        extra = extra_pairs_of(request.pairs, config)
        batches = batches_of([*request.pairs, *extra]) if config is not None else {}
        state = State(request, extra, batches)
        state.restore(self.store, self._digests(state))  # the only time that the store is read
        self._leave_out(state)
        self.state = state
        self._resumed = int(state.complete.sum())
        if self._resumed:
            self._progress.note(f"{self._resumed} of {state.rows} pairs are there")
        self._explained = ""
        self._is_announced = False
        self._until = inf
        if share < 1:
            self._until = self.budget.clock() + share * self.budget.left()
        # Publish existing results before any work: a former F is better than the fallback.
        self._publish()
        self._loop()

    def report(self) -> RunReport:
        """End the run. Return the results of the latest request."""
        self._end()
        state = self.state
        assert state is not None, "nothing was asked for"
        return RunReport(
            tuple(read_records(self.store, state.table())),
            self.ending,
            self.budget.spent(),
            self._resumed,
            tuple(self.faults),
            tuple(self.explanations),
            self.unwritten,
            scene_records(state),
            self.units_run,
            self.estimated,
            self.site.printed(),
        )

    def digest_files(self, files: Mapping[str, Path]) -> dict[str, str]:
        """Return the digest of each file's content by name; files that cannot be read are left out."""
        pool = ThreadPoolExecutor(HASH_THREADS)
        futures = {name: pool.submit(content_digest, path) for name, path in files.items()}
        pending = set(futures.values())
        while pending and not self._is_over(self.budget.clock()):
            _, pending = wait(pending, LISTEN_S)
        pool.shutdown(wait=False, cancel_futures=True)  # a file of many GB takes long
        digests = {}
        for name, future in futures.items():
            if future.done() and not future.cancelled() and not future.exception():
                digests[name] = future.result()
        return digests

    def _digests(self, state: State) -> dict[str, str]:
        """Return the known digests of images, by name. Digest a file again if its size or time has
        changed.
        """
        files: dict[str, Path] = {}
        for pair, names in zip(state.pairs, state.names, strict=True):
            files |= zip(names, pair.images, strict=True)
        about = self.store.about(IMAGE + name for name in files)
        known = {name: about[IMAGE + name] for name in files if IMAGE + name in about}
        touched = {}
        for name, facts in known.items():
            now = file_state(files[name])
            # A missing file keeps its results: perhaps nothing must be matched.
            if any(now) and now != tuple(facts["file"]):
                touched[name] = now
        found = self.digest_files({name: files[name] for name in touched})
        self.store.put(file_result(name, digest, touched[name]) for name, digest in found.items())
        changed = {name for name, digest in found.items() if digest != known[name]["digest"]}
        if changed:
            count = sum(not changed.isdisjoint(names) for names in state.names)
            text = f"{len(changed)} images have changed: their {count} pairs are matched again"
            console.warn(text)
            self._fault(text)
        return {name: facts["digest"] for name, facts in known.items()} | found

    # The loop

    def _loop(self) -> None:
        while not self._is_over(now := self.budget.clock()):
            # All answers first, so that idle workers get the best of what is known now.
            for place in self.site.places:
                self._take_answer(place, now)
            self._fall_back()
            if not self._hand_out(now):
                return
            if now - self._published > max(PUBLISH_INTERVAL_S, self.budget.writing / PUBLISH_SHARE):
                self._publish()
            limits = [place.limit for place in self.site.places if place.limit > now]
            self.site.wait(min([self.budget.stop_waiting, *limits, inf]))

    def _is_over(self, now: float) -> bool:
        return self.interrupt.is_set() or now >= self.budget.stop_waiting

    @property
    def crew(self) -> Crew:
        """The workers that there are now."""
        matchers = [place for place in self.site.of(Work.MATCH) if not place.closed]
        scenes = [place for place in self.site.of(Work.SCENE) if not place.closed]
        return Crew(
            max(1, len(matchers)),
            len(self.site.of(Work.LIGHT)),
            len(scenes),
            self.minibatch,
            can_match=bool(matchers) or not self._is_open,
        )

    def _hand_out(self, now: float) -> bool:
        """Give jobs to idle workers, and start workers for further jobs. Return whether any is
        under way.
        """
        work: NextWork | None = None
        if self.state is not None:
            work = self._next_work(self.state, now)
        # A finished run joins no cluster and starts no worker of matching.
        if work is not None and work.match is not None and not self._is_open:
            self.site.open()
            self._is_open = True
        # How many workers each kind of work needs beside those that are at work.
        needs = {
            Work.MATCH: self._hand_out_pairs(work, now),
            Work.LIGHT: self._hand_out_light(work, now),
            Work.SCENE: self._hand_out_scenes(work, now),
        }
        is_under_way = False
        for place in self.site.places:
            if place.may_start(now) and needs[place.work] > 0:
                timeout = START_TIMEOUT_S
                # Other workers load no matchers: one that takes long to start hangs.
                if place.work is not Work.MATCH:
                    timeout = min(timeout, max(self.budget.silence, self._unknown(now)))
                place.start(now, timeout)
            if place.is_starting and needs[place.work] > 0:
                is_under_way = True
                if place.work is Work.SCENE:
                    # A process for each scene. Matching and estimates share what there is.
                    needs[place.work] -= 1
            if place.job is not None:
                is_under_way = True
        return is_under_way

    def _hand_out_pairs(self, work: NextWork | None, now: float) -> int:
        """Give pairs to idle workers. Return whether pairs are left for more workers."""
        if work is None or self.state is None:
            return 0
        places = self.site.of(Work.MATCH)
        idle = [place for place in places if place.is_idle]
        others = any(place.may_start(now) or place.is_starting for place in places)
        job = work.match
        while job is not None and idle:
            filled = self._filled(job)
            if filled is not None:
                self._give(idle.pop(0), filled, now)
            job = None
            # The next job is looked for only if somebody could do it.
            if idle or others:
                following = self._next_work(self.state, now)
                job = following.match if following is not None else None
        return int(job is not None)

    def _next_work(self, state: State, now: float) -> NextWork | None:
        """Return what to do next; ``None`` if the time of a trial is over. Explain a change of the
        phase.
        """
        if now >= self._until:
            return None
        work = next_work(state, self.costs, self.budget, self.crew, now)
        if work.match is not None:
            self._shown = work
            if work.phase is not Phase.SWEEP:
                self._explain_phase(state, work, now)
        return work

    def _explain_phase(self, state: State, work: NextWork, now: float) -> None:
        """Explain a change of the phase or of the units that fit. Announce the outlook once it is
        measured.
        """
        fitting = f"{work.phase} {work.fit if work.phase is Phase.DEEPEN else ''}"
        if fitting == self._explained and self._is_announced:
            return
        text = outlook(state, self.costs, self.budget, self.crew, now)
        if not text:
            fitting = f"{work.phase}, unmeasured"
        if fitting != self._explained:
            self.explain(f"{work.phase}: {text or 'not all units were measured yet'}")
            self._explained = fitting
        if text and not self._is_announced:
            self._progress.note(text)
            self._is_announced = True

    def _hand_out_light(self, work: NextWork | None, now: float) -> int:
        """Give features and estimates to idle workers. Return how many are left."""
        due = list(work.estimates) if work is not None else []
        for place in [place for place in self.site.of(Work.LIGHT) if place.is_idle]:
            # Features first: pairs are chosen by them.
            if self._features:
                key = next(iter(self._features))
                self._give(place, self._features.pop(key), now)
            elif due and self.state is not None:
                self._give(place, self._estimate_job(self.state, due), now)
                due = [index for index in due if not self.state.estimating[index]]
        return len(self._features) + len(due)

    def _hand_out_scenes(self, work: NextWork | None, now: float) -> int:
        """Give scenes to idle workers. Return how many are left that may begin now."""
        if work is None or self.state is None:
            return 0
        due = list(work.scenes)
        places = self.site.of(Work.SCENE)
        for place in [place for place in places if place.is_idle]:
            if due:
                self._give(place, self._scene_job(self.state, due.pop(0)), now)
        # While matching uses the other cores, scenes have those that it leaves free.
        is_matching = work.match is not None or bool(self.state.matching.any())
        at_work = sum(place.job is not None for place in places)
        return min(len(due), self.site.scenes_at_a_time(is_matching=is_matching) - at_work)

    def _give(self, place: Place, job: Job, now: float) -> None:
        place.submit(job, self._time_limit(job, now), now)

    def _filled(self, job: MatchJob) -> MatchJob | None:
        """Return the job with its pairs, and the points that their crops come from."""
        state = self.state
        assert state is not None
        state.begin(state.matching, job.indices)
        if job.phase is Phase.FILL:
            state.begin(state.filling, job.indices)
        # Crops come from points of today alone. Others may be of former settings.
        crops = [tuple(state.first_stage(index)) for index in job.indices]
        known: list[tuple[UnitResult, ...]] = [()] * len(crops)
        if any(unit.stage == 2 for unit in job.units):
            try:
                known = [
                    self._points_of(index, keys)
                    for index, keys in zip(job.indices, crops, strict=True)
                ]
            except (sqlite3.Error, KeyError) as error:  # a disk that fails
                self._lose_job(job, Failure(Cause.RAISED, f"the store cannot be read: {error}"))
                return None
        else:
            crops = [()] * len(crops)  # no unit needs them
        upcoming = upcoming_pairs(state, job, self.minibatch)
        return replace(
            job,
            pairs=tuple(state.pairs[index] for index in job.indices),
            names=tuple(state.names[index] for index in job.indices),
            known=tuple(known),
            crops=tuple(crops),
            upcoming=tuple(path for index in upcoming for path in state.pairs[index].images),
        )

    def _points_of(self, index: int, keys: Sequence[str]) -> tuple[UnitResult, ...]:
        assert self.state is not None
        data = self.store.data(keys)
        units = (
            {key: unit for unit, key in self.state.inputs_of(index).points.items()} if keys else {}
        )
        return tuple(UnitResult(units[key], from_bytes(data[key])) for key in keys)

    def _estimate_job(self, state: State, due: Sequence[int]) -> EstimateJob:
        """Return a job for the first pairs; a pair whose job was lost before is alone in its job."""
        alone = {index for index in due if ("estimate", index) in state.tries.alone}
        is_retry = due[0] in alone
        chosen = [due[0]]
        if not is_retry:
            chosen = [index for index in due if index not in alone][:MAX_ESTIMATES]
        taken: list[int] = []
        for index in chosen:
            if not state.estimating[index]:  # as a row with the same images, which is estimated
                state.begin(state.estimating, [index])
                taken.append(index)
        pairs = tuple(state.inputs_of(index) for index in taken)
        source = self.store.source([key for pair in pairs for key in pair.points.values()])
        return EstimateJob(pairs, state.request.recipe, source, is_retry)

    def _scene_job(self, state: State, batch: str) -> SceneJob:
        state.reconstructing.add(batch)
        # Of the results in use now. If others come meanwhile, the scene is stale when it arrives.
        indices, key = state.scene_inputs(batch)
        pairs = tuple(state.inputs_of(index) for index in indices)
        matches = int(state.matches[indices].sum())
        export = state.request.exports.get(batch)
        if export is not None:
            self.store.remove(EXPORT + batch)  # from now on its files may be replaced
        self._progress.note(f"batch {batch}: reconstructing its cameras from {len(pairs)} pairs")
        source = self.store.source([key for pair in pairs for key in pair.points.values()])
        contents = tuple(state.contents(index) for index in indices)
        return SceneJob(batch, key, pairs, contents, state.request.recipe, source, matches, export)

    def _time_limit(self, job: Job, now: float) -> float:
        """Return the seconds after which a worker counts as hung, from measured costs or from the
        time left.
        """
        patience: float | None = None
        match job:
            case MatchJob():
                patience = match_patience(self.costs, job)
            case EstimateJob():
                patience = estimate_patience(self.costs, len(job.pairs))
            case SceneJob():
                patience = scene_patience(self.costs, job.matches)
        return self.budget.silence + (self._unknown(now) if patience is None else patience)

    def _unknown(self, now: float) -> float:
        left = max(0.0, self.budget.stop_units - now)
        return min(MAX_UNKNOWN_S, UNKNOWN_SHARE * left)

    # Answers

    def _take_answer(self, place: Place, now: float) -> None:
        if place.job is not None:
            # By the costs known now.
            place.limit = place.since + self._time_limit(place.job, place.since)
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
            self._lose(place, job, answer)
        elif job is not None:
            self._save(job, answer, seconds)
        if place.work is Work.SCENE:
            place.kill()  # pycolmap's memory does not return

    def _note_loaded(self, place: Place, answer: Loaded) -> None:
        """Go on without the matchers that could not be loaded, and say so once."""
        self._has_loaded = self._has_loaded or place.work is Work.MATCH
        for name, reason in answer.refused.items():
            if name not in self._refused:
                self._refused[name] = reason
                text = f"{name} is left out: {reason}"
                self.explain(text)
                self._fault(text)
                console.warn(text)
        if self.state is not None:
            self._leave_out(self.state)

    def _leave_out(self, state: State) -> None:
        """Skip the units whose matchers could not be loaded."""
        for unit in state.units:
            if unit.matcher in self._refused:
                failure = Failure(Cause.REFUSED, self._refused[unit.matcher])
                state.give_up(("matcher", unit.name), failure)

    def _save(self, job: Job, answer: Answer, seconds: float) -> None:
        """Save an answer. If it cannot be saved, only this job fails."""
        try:
            self._take(job, answer, seconds)
        except sqlite3.Error as error:
            text = f"a result cannot be saved: {error}"
            self._fault(text)
            self._lose_job(job, Failure(Cause.RAISED, text))
        if self.store.trouble:
            trouble = f"the journal cannot be written ({self.store.trouble})"
            self._fault(f"{trouble}; results stay in memory")
        if isinstance(job, SceneJob) and job.export is not None:
            self._publish()

    def _take(self, job: Job, answer: Any, seconds: float) -> None:
        match job:
            case FeatureJob():
                assert isinstance(answer, Found)
                value = answer.value
                is_data = isinstance(value, bytes)
                row = Result(
                    job.key, Kind.FEATURES, None if is_data else value, value if is_data else b""
                )
                self.store.put([row])
                self._found[job.key] = value
            case MatchJob():
                self._take_points(job, answer)
            case EstimateJob():
                self._take_estimates(job, answer)
            case SceneJob():
                self._take_scene(job, answer, seconds)

    def _take_points(self, job: MatchJob, answer: Sequence[Outcome]) -> None:
        state = self.state
        assert state is not None
        results = [
            state.results_of(outcome, crops)
            for outcome, crops in zip(answer, job.crops, strict=True)
        ]
        # First the store, in one transaction: what the state has is never lost.
        self.store.put(result for rows in results for result in rows)
        state.end(state.matching, job.indices)
        state.end(state.filling, job.indices)
        for outcome, rows in zip(answer, results, strict=True):
            state.take(outcome, rows)
            for found in outcome.found:
                self.costs.observe(found.unit.name, found.seconds, warm_up=found.warm_up)
                self.units_run += 1
        if (work := self._shown) is not None:
            # The pairs of this answer are done, too.
            done = min(work.total, work.done + len(job.indices))
            self._progress.show(str(work.phase), done, work.total)

    def _take_estimates(self, job: EstimateJob, answer: Sequence[Any]) -> None:
        state = self.state
        assert state is not None
        results = [state.estimate_result(each) for each in answer]
        self.store.put(results)
        state.end(state.estimating, (each.index for each in answer))
        for each, result in zip(answer, results, strict=True):
            state.take_estimate(each, result)
            self.costs.observe(ESTIMATE, each.seconds)
        self.estimated += len(answer)
        # While pairs are matched, the bar shows those.
        if not state.matching.any():
            total = int(state.has[: state.rows].any(1).sum())
            done = total - int(lacking_estimates(state).sum())
            self._progress.show("estimate", done, total)

    def _take_scene(self, job: SceneJob, answer: Any, seconds: float) -> None:
        """Save a reconstruction, even if it is already out of date."""
        state = self.state
        assert state is not None
        rows = [state.scene_result(job, answer, seconds)]
        # In the same transaction: the mark says that these files are of this scene.
        if job.export is not None:
            rows.append(Result(EXPORT + job.batch, Kind.EXPORT, job.key))
        self.store.put(rows)
        self.costs.observe_scene(job.matches, seconds)
        state.reconstructing.discard(job.batch)
        record = SceneRecord.of_solution(job.batch, answer, job.contents, seconds)
        state.use_scene(job.batch, job.key, record)
        if state.scene_inputs(job.batch)[1] == job.key:
            state.stale.discard(job.batch)
        text = f"{record.registered} of {record.images} images"
        self._note(EventKind.SCENE, f"{job.batch}: {text}")
        self._progress.note(f"batch {job.batch}: {text} have a camera")

    def _lose(self, place: Place, job: Job | None, failure: Failure) -> None:
        """Record that a worker failed on a job, or could not start."""
        if job is None:
            self._fault(f"{place.name}: {failure}")
        else:
            self._fault(f"a job was lost on {place.name}: {failure}")
        if place.closed:
            self.explain(f"no worker is started any more on {place.closed}")
        if job is not None:
            self._lose_job(job, failure)
        state = self.state
        if state is not None and place.work is Work.SCENE and not self.crew.scenes:
            state.give_up(("scenes",), failure)

    def _lose_job(self, job: Job, failure: Failure) -> None:
        """Retry what a lost job had to do, one by one. Give up what is lost twice in its own job."""
        state = self.state
        match job:
            case FeatureJob():
                if not self._tries.lose([("features", job.key)], failure):
                    self._features[job.key] = job
            case MatchJob():
                assert state is not None
                state.end(state.matching, job.indices)
                state.end(state.filling, job.indices)
                self._lose_points(state, job, failure)
            case EstimateJob():
                assert state is not None
                indices = [pair.index for pair in job.pairs]
                state.end(state.estimating, indices)
                if state.tries.lose([("estimate", index) for index in indices], failure):
                    self.explain(f"pair {indices[0]} keeps the F it has: {failure}")
            case SceneJob():
                assert state is not None
                self._fault(f"batch {job.batch} was not reconstructed: {failure}")
                state.reconstructing.discard(job.batch)
                if state.tries.lose([("scene", job.batch, job.key)], failure):
                    # Until its inputs change.
                    state.stale.discard(job.batch)

    def _lose_points(self, state: State, job: MatchJob, failure: Failure) -> None:
        items = [("unit", index, unit.name) for index in job.indices for unit in job.units]
        if failure.cause is Cause.DEVICE:  # counts against the worker's place, not the unit
            state.tries.alone.update(items)
            return
        if not state.tries.lose(items, failure):
            return
        ((_, index, name),) = items
        state.give_up(items[0], failure)
        self.explain(f"{name} is skipped on pair {index} ({failure})")
        # A unit that never ran on any pair would cost two workers for each.
        given_up = Counter(state.given_up_units())
        if given_up[name] >= MAX_FAILED_PAIRS and not self.costs.mean(name):
            state.give_up(("matcher", name), failure)
            self.explain(f"{name} is skipped on all pairs: it never ran ({failure})")

    def _fall_back(self) -> None:
        """Continue on the fallback places once all matching places are closed, or every unit is
        skipped.
        """
        places = self.site.of(Work.MATCH)
        is_closed = self._is_open and all(place.closed for place in places)
        nothing_runs = self.state is not None and bool(self.state.unusable.all())
        reason = "; ".join(place.closed for place in places if place.closed)
        if self.site.fallback and (is_closed or nothing_runs):
            what = self.site.fallback[0].name
            text = f"matching continues on the {what}: {reason or Ending.NOTHING_RUNS}"
            self._fault(text)
            self.explain(text)
            console.warn(text)
            # Their costs, losses and refusals say nothing about the other device.
            for place in places:
                place.kill()
                self.site.places.remove(place)
            self.site.places += self.site.fallback
            self.site.fallback = []
            self.costs = Costs()
            self._refused = {}
            self._explained = ""
            if self.state is not None:
                self.state.forget_failures()
        elif is_closed and not self._has_loaded and places:
            raise UserError(f"no worker could be started: {reason}")

    # Results

    def save_results(self) -> str:
        """Write the results unless the run has ended. Return why that failed, or an empty text.
        Thread-safe.
        """
        with self._publishing:
            state = self.state
            if state is not None and not self._has_ended:
                try:
                    state.request.publish(state)
                    self.unwritten = ""
                except OSError as error:
                    self.unwritten = f"the results cannot be written: {error}"
        return self.unwritten

    def _publish(self) -> None:
        """Write the results, and the table of pairs that says what they are."""
        state = self.state
        if state is None or not state.rows:
            return
        start = self.budget.clock()
        if trouble := self.save_results():
            self._fault(trouble)
        # A trial's pairs are not the run's, whose table stays until its own pairs are known.
        if not state.request.is_trial:
            self.store.put([state.table().to_result()])
        self._published = self.budget.clock()
        self.budget.note_write(self._published - start)

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
            return Ending.COMPLETE
        places = self.site.of(Work.MATCH)
        is_closed = self._is_open and all(place.closed for place in places)
        return Ending.NO_WORKER if is_closed else Ending.TIME_IS_UP

    # Events

    def explain(self, text: str) -> None:
        """Record a decision."""
        self.explanations.append(self._note(EventKind.PLAN, text))

    def _fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)
            self._note(EventKind.FAULT, text)

    def _note(self, kind: EventKind, text: str) -> Event:
        event = Event(kind, self.budget.spent(), text)
        note_event(self.store, event)
        return event


def note_event(store: Store, event: Event) -> None:
    store.put([Result(f"event {token_hex(8)}", Kind.EVENT, asdict(event))])


def scene_records(state: State) -> tuple[SceneRecord, ...]:
    """Return the scene of each batch, in order; ``failure`` is the reason for a missing scene."""
    reasons = {}
    everywhere = state.tries.given_up.get(("scenes",))
    for item, failure in state.tries.given_up.items():
        match item:
            case ("scene", str(batch), _):
                reasons[batch] = str(failure)
    records = []
    for batch in state.batches:
        reason = reasons.get(batch) or (str(everywhere) if everywhere else NOT_RECONSTRUCTED)
        records.append(state.scenes.get(batch) or SceneRecord(batch, failure=reason))
    return tuple(records)


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the pair indices of each batch that can be reconstructed: two or more pairs without
    intrinsics.
    """
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Return pairs that no row names, for the scenes of their batches, the most useful first.

    Each batch is filled up to ``pairs_per_image``, the batch with the fewest pairs per image first.
    """
    if config is None or not config.pairs_per_image:
        return []
    extra: list[tuple[float, Pair]] = []
    for batch, indices in batches_of(pairs).items():
        files = list(
            dict.fromkeys(
                file for index in indices for file in (pairs[index].file0, pairs[index].file1)
            )
        )
        number = {file: index for index, file in enumerate(files)}
        ends = [(number[pairs[index].file0], number[pairs[index].file1]) for index in indices]
        distinct = len({tuple(sorted(pair)) for pair in ends})
        more = extra_pairs(len(files), ends, config.pairs_per_image)
        for count, (i, j) in enumerate(more, start=distinct):
            name = f"{batch};{Path(files[i]).stem}-{Path(files[j]).stem}"
            extra.append((count / len(files), Pair(name, batch, files[i], files[j])))
    return [pair for _, pair in sorted(extra, key=lambda each: each[0])]
