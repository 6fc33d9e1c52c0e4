"""The table of scenes: which batches to reconstruct in parallel with matching, when, and at what cost."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Failure, Losses, Phase, SceneJob
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import EventKind, SceneRecord
from mkpc_kaggle.engine.plan import HANG_FACTOR, Plan
from mkpc_kaggle.engine.request import Chronicle, Request
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.engine.tables import Estimates
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.export import has_files
from mkpc_kaggle.scene.reconstruct import Solution

MIN_PAIRS = 2  # the minimum to connect three images
START_S = 3.0  # start-up time of a process
MATCH_S = 5e-4  # per match of a reconstruction: initial forecast, and lower bound for a hang
FORECAST_MARGIN = 1.5  # factor on a forecast from earlier scenes' matches
NOT_RECONSTRUCTED = "not reconstructed in time"


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the pair indices of each batch that can be reconstructed: two or more pairs without intrinsics."""
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
        files = list(dict.fromkeys(file for index in indices for file in (pairs[index].file0, pairs[index].file1)))
        number = {file: index for index, file in enumerate(files)}
        ends = [(number[pairs[index].file0], number[pairs[index].file1]) for index in indices]
        distinct = len({tuple(sorted(pair)) for pair in ends})
        for count, (i, j) in enumerate(extra_pairs(len(files), ends, config.pairs_per_image), start=distinct):
            key = f"{batch};{Path(files[i]).stem}-{Path(files[j]).stem}"
            extra.append((count / len(files), Pair(key, batch, files[i], files[j])))
    return [pair for _, pair in sorted(extra, key=lambda each: each[0])]


def standing_scenes(journal: Journal, request: Request) -> dict[str, SceneRecord]:
    """Return the standing scene of each batch. Forget a scene whose exported files were removed."""
    made = journal.scenes("scene") if request.exports else journal.scenes()
    for batch in request.exports.keys() & made.keys():
        if not has_files(request.exports[batch], len(made[batch].models)):
            journal.forget_scene(batch)
            del made[batch]
    return made


class Scenes:
    """The scenes of a request's ``batches``, which map a batch's name to the positions of its pairs.

    ``made`` has the standing scene of each batch, current or not. ``losses`` has the reasons of failures.
    """

    def __init__(
        self,
        batches: Mapping[str, list[int]],
        made: dict[str, SceneRecord],
        state: State,
        plan: Plan,
        estimates: Estimates,
        chronicle: Chronicle,
    ) -> None:
        self.batches, self.made = batches, made
        self.losses: Losses[str] = Losses()
        self._state, self._plan, self._estimates, self._chronicle = state, plan, estimates, chronicle
        self._stale = set(batches) - state.journal.current_scenes()
        self._running: set[str] = set()
        self._batch_of = {index: name for name, indices in batches.items() for index in indices}
        self._seconds, self._done = 0.0, 0  # of this run's scenes: total time, total matches

    def waiting(self) -> list[str]:
        """Return the batches to reconstruct; batches without any scene come first."""
        changed = {self._batch_of[index] for index in self._state.changed if index in self._batch_of}
        self._state.changed.clear()
        self._stale |= changed
        for name in changed:
            self.losses.skipped.pop(name, None)
        stale = self._stale - self._running - self.losses.skipped.keys()
        waiting = (name for name in self.batches if name in stale and self._matches(name))
        return sorted(waiting, key=self.made.__contains__)

    def reserve(self) -> float:
        """Return the seconds that the pending reconstructions will probably take."""
        return sum(self._forecast(self._matches(name)) for name in self._stale - self.losses.skipped.keys())

    def has_work(self, now: float) -> bool:
        return self._due(now) is not None

    def next(self, now: float) -> SceneJob | None:
        if (batch := self._due(now)) is None:
            return None
        self._running.add(batch)
        state, request = self._state, self._state.request
        pairs, source = state.points_of(index for index in self.batches[batch] if state.had[index].any())
        self._chronicle.progress.note(f"batch {batch}: reconstructing its cameras from {len(pairs)} pairs")
        inputs, export = state.journal.batch_inputs(batch), request.exports.get(batch)
        return SceneJob(batch, pairs, request.recipe, source, inputs, self._matches(batch), export)

    def patience(self, job: SceneJob) -> float:
        return HANG_FACTOR * max(self._forecast(job.matches), START_S + MATCH_S * job.matches)

    def save(self, job: SceneJob, answer: Solution, seconds: float) -> None:
        """Save a reconstruction, even if it is already out of date."""
        journal, record = self._state.journal, SceneRecord.of(job.batch, answer.reconstructions, seconds)
        if job.export is not None:
            journal.forget_scene(job.batch)  # its old files are replaced
        journal.save_scene(record, job.inputs, job.pairs, answer.choices)
        self._seconds, self._done = self._seconds + max(0.0, seconds - START_S), self._done + job.matches
        self._running.discard(job.batch)
        self.made[job.batch] = record
        if journal.batch_inputs(job.batch) == job.inputs:
            self._stale.discard(job.batch)
        self._state.read_choices()
        text = f"{record.registered} of {record.images} images"
        self._chronicle.note(EventKind.SCENE, f"{job.batch}: {text}")
        self._chronicle.progress.note(f"batch {job.batch}: {text} have a camera")

    def lose(self, job: SceneJob, failure: Failure) -> None:
        """Try a lost reconstruction once more in this run, and again in the next run."""
        self._chronicle.fault(f"batch {job.batch} was not reconstructed: {failure}")
        self._running.discard(job.batch)
        self.losses.add([job.batch], failure)

    def skip_all(self, failure: Failure) -> None:
        """Skip all pending batches: no worker can reconstruct them."""
        self.losses.skipped |= dict.fromkeys(self._stale, failure)

    def report(self) -> tuple[SceneRecord, ...]:
        """Return the scene of each batch, in order; ``failure`` is the reason for a missing scene."""
        missing = {name: str(self.losses.skipped.get(name, NOT_RECONSTRUCTED)) for name in self.batches}
        return tuple(self.made.get(name) or SceneRecord(name, failure=missing[name]) for name in self.batches)

    def _due(self, now: float) -> str | None:
        """Return a batch to reconstruct now, if any.

        A batch's first scene waits for the units that fit in time, later scenes for all units until matching ends.
        """
        if not (waiting := self.waiting()):
            return None
        pending, plan = self._estimates.pending(now), self._plan
        if plan.busy.any() or plan.has_work(now):
            phases = {False: Phase.FILL, True: Phase.NEVER}
            ready = {is_made: plan.settled(now, phase) & ~pending for is_made, phase in phases.items()}
        else:
            ready = dict.fromkeys((False, True), ~pending | (now >= plan.stop))  # too late to wait for estimates
        return next((name for name in waiting if ready[name in self.made][self.batches[name]].all()), None)

    def _matches(self, batch: str) -> int:
        return int(self._state.matches[self.batches[batch]].sum())

    def _forecast(self, matches: int) -> float:
        """Return the seconds that a reconstruction will probably take."""
        rate = FORECAST_MARGIN * self._seconds / self._done if self._done else MATCH_S
        return START_S + matches * rate
