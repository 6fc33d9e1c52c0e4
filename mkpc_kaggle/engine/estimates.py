"""Estimates of pairs, and features of images: jobs of the workers that do not match, results, losses."""

import sqlite3
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mkpc_kaggle.engine.jobs import Cause, Estimated, EstimateJob, Failure, FeatureJob, Found
from mkpc_kaggle.engine.plan.blame import Tries
from mkpc_kaggle.engine.plan.budget import ESTIMATE
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.store.database import Source, Store, parts_of
from mkpc_kaggle.engine.store.tables import Feature, PairEstimate, UnitPoints

# In a job. More pairs would make the last F of a run wait for each other; single pairs, each with a
# message and a transaction, would cost the loop more.
MAX_PAIRS = 8
# If this number of estimates was lost everywhere, and none ever succeeded, no other is tried.
MAX_FAILED_ESTIMATES = 2


class Estimating:
    """Jobs that estimate F of a few pairs each."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def split(self, due: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return the pairs for the workers of estimates, and the pairs that these gave up."""
        given_up = self._run.state.tries.given_up
        elsewhere = [index for index in due if ("estimate", index) in given_up]
        return [index for index in due if index not in elsewhere], elsewhere

    def job(self, due: Sequence[int], *, is_trial: bool = False) -> EstimateJob | None:
        """Return a job for the first pairs that are due, with their points. A pair whose job was
        lost is alone in its job; on trial, a place gets other pairs first.

        Return ``None`` if points cannot be read: these pairs are planned again.
        """
        run = self._run
        state = run.state
        alone = {index for index in due if ("estimate", index) in state.tries.alone}
        others = [index for index in due if index not in alone]
        chosen = [due[0]]
        if others and (is_trial or due[0] not in alone):
            chosen = others[:MAX_PAIRS]
        state.begin_estimates(chosen)
        pairs = tuple(state.inputs_of(index) for index in chosen)
        recipe = state.request.recipe
        try:
            # A worker that opened the store by its path would depend on where the path leads now.
            source = run.source(pairs, held=True)
        except sqlite3.Error as error:  # a disk that fails
            failure = Failure(Cause.RAISED, f"the store cannot be read: {error}")
            run.log.fault(str(failure))
            self.lose(EstimateJob(pairs, recipe, Source(UnitPoints)), failure)
            return None
        if source is None:
            state.end_estimates(chosen)
            return None
        return EstimateJob(pairs, recipe, source)

    def save(self, job: EstimateJob, answer: Sequence[Estimated], seconds: float) -> None:
        run = self._run
        state = run.state
        # Under the key of the points that the worker read, which may be older than the state's.
        results = []
        for pair, estimated in zip(job.pairs, answer, strict=True):
            key = state.request.keys.of_estimate(state.pairs[pair.index], estimated.points)
            results.append(_estimate(key, estimated))
        run.store.put(results)
        state.end_estimates(pair.index for pair in job.pairs)
        for pair, estimated, result in zip(job.pairs, answer, results, strict=True):
            # Of an image that was replaced meanwhile, the estimate belongs to the former content.
            if state.images_of(pair.index) == pair.images:
                state.use_new_estimate(pair.index, result)
            run.costs.observe(ESTIMATE, estimated.seconds)
        run.log.estimated += len(answer)
        # While pairs are matched, the bar shows those.
        if not state.matching.any():
            total = int(state.has[: state.rows].any(1).sum())
            pending = int(state.lacks_estimate.sum())
            run.progress.count("estimate", total - pending, total)

    def lose(self, job: EstimateJob, failure: Failure) -> None:
        run = self._run
        state = run.state
        indices = [pair.index for pair in job.pairs]
        state.end_estimates(indices)
        state.lose_estimates(indices, failure)
        tries = state.tries
        if ("estimate", indices[0]) in tries.given_up:
            self.give_up(indices[0])
        elif tries.lose([("estimate", index) for index in indices], failure):
            # The cause may lie in these workers. An estimate is cheap, so another process tries it.
            run.log.explain(f"pair {indices[0]} is estimated in another process: {failure}")

    def give_up(self, index: int) -> None:
        """Give up an estimate that was lost elsewhere, too, or that no other process can try."""
        run = self._run
        state = run.state
        nowhere = Failure(Cause.NOT_STARTED, "no worker estimates any more")
        failure = state.lost_estimates.get(index, nowhere)
        state.give_up(("estimate elsewhere", index), failure)
        run.log.explain(f"pair {index} keeps the F it has: {failure}")
        # Estimates that never succeed would cost three processes for each pair.
        lost = sum(item[0] == "estimate elsewhere" for item in state.tries.given_up)
        if lost < MAX_FAILED_ESTIMATES or run.log.estimated:
            return
        state.give_up_estimates(failure)
        run.log.explain(f"no pair is estimated any more: {failure}")


def _estimate(key: str, found: Estimated) -> PairEstimate:
    stats = found.stats
    return PairEstimate(
        key,
        inliers=dict(zip(found.points, found.inliers, strict=True)),
        F=found.F,
        failure=found.failure,
        magsac=found.magsac,
        seconds=found.seconds,
        candidates=stats.candidates,
        cost=stats.cost,
        magsac_cost=stats.magsac_cost,
        focal0=stats.focals[0],
        focal1=stats.focals[1],
        support=stats.support,
        rotation=stats.rotation,
    )


class Features:
    """Features of images by key: the ones ``found``, and the jobs ``pending``. Of features that are data,
    such as descriptors, only the store has the value: those of a large folder would fill the memory.

    They come before any pair: similar images and orientations decide which pairs there are.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._tries = Tries()  # the tries of pairs belong to a request's state
        self.found: dict[str, Any] = {}
        self.pending: dict[str, FeatureJob] = {}

    def ask(self, jobs: Mapping[str, Callable[[], Any]]) -> None:
        """Find features in the store; the others become pending."""
        features = self._store.get(Feature, jobs)
        self.found = {key: feature.value for key, feature in features.items()}
        # Features that are no JSON value are data, which may be damaged.
        data = [key for key, value in self.found.items() if value is None]
        for part in parts_of(data):
            for key in set(part) - self._store.data(Feature, part).keys():
                del self.found[key]
        self.pending = {
            key: FeatureJob(key, do) for key, do in jobs.items() if key not in self.found
        }

    def next(self) -> FeatureJob:
        """Return the next pending job, which is under way then."""
        # In the order of asking: a dict keeps it.
        return self.pending.pop(next(iter(self.pending)))

    def save(self, job: FeatureJob, answer: Found, seconds: float) -> None:
        value = answer.value
        # Keypoints and descriptors are bytes; partners of images are JSON.
        is_data = isinstance(value, bytes)
        self._store.put([Feature(job.key, None, value) if is_data else Feature(job.key, value)])
        self.found[job.key] = None if is_data else value

    def lose(self, job: FeatureJob, failure: Failure) -> None:
        # A feature lost twice is left out: its image is compared with no other.
        if not self._tries.lose([("features", job.key)], failure):
            self.pending[job.key] = job
