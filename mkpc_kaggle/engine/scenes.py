"""Scenes of batches: their jobs, results and losses."""

import sqlite3
from collections.abc import Sequence

from mkpc_kaggle.engine.console import EventKind
from mkpc_kaggle.engine.jobs import Cause, Failure, PairInputs, SceneJob
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.store.keys import of_candidate
from mkpc_kaggle.engine.store.tables import (
    NOT_RECONSTRUCTED,
    Export,
    SceneRecord,
    unmatched_scene,
)
from mkpc_kaggle.errors import plural
from mkpc_kaggle.scene.candidates import ALL_UNITS, title_of
from mkpc_kaggle.scene.sfm import Solution


class SceneWork:
    """Jobs that make a candidate of a batch's scene each."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def job(self, batch: str, candidate: str = ALL_UNITS) -> SceneJob | None:
        """Return the job of a batch's candidate, from the results in use now; ``None`` if points are
        lost, which are matched again.

        If its pairs get other results meanwhile, the scene is stale when it arrives.
        """
        run = self._run
        state = run.state
        indices, key = state.scene_inputs(batch)
        pairs = tuple(state.inputs_of(index) for index in indices)
        try:
            source = run.source(pairs)
        except sqlite3.Error as error:  # a disk that fails
            failure = Failure(Cause.RAISED, f"the store cannot be read: {error}")
            self._count_loss(batch, candidate, key, failure)
            return None
        if source is None:
            state.scenes.end(batch, candidate)
            return None
        folder = state.request.exports.get(batch)
        state.scenes.begin(batch, candidate)
        # The first candidate has files, until the best one is made again for its own.
        has_files = candidate == ALL_UNITS or candidate in state.scenes.made[batch]
        export = folder if has_files else None
        if export is not None:
            # From now on the files may be replaced, so they belong to no stored scene.
            run.store.remove(Export, batch)
        return SceneJob(
            batch,
            of_candidate(key, candidate),
            pairs,
            contents=tuple(state.contents(index) for index in indices),
            recipe=state.request.recipe,
            source=source,
            matches=state.matches_of_candidate(batch, candidate),
            export=export,
            cameras=state.request.cameras,
            candidate=candidate,
            scene=key,
            is_whole=folder is not None,
        )

    def save(self, job: SceneJob, answer: Solution, seconds: float) -> None:
        """Save and use a scene, even if it is stale: the former scene is older still.

        A further candidate is used only if it is the best one from the results in use.
        """
        run = self._run
        state = run.state
        choices = dict(zip(job.contents, answer.choices, strict=True))
        record = SceneRecord.of(
            job.batch,
            answer.reconstructions,
            seconds,
            choices,
            job.candidate,
            answer.disagreement,
            key=job.key,
        )
        # In the same transaction, a mark: these files belong to this scene.
        marks = [] if job.export is None else [Export(job.batch, job.key)]
        run.store.put([record, *marks])
        # The time of the loop, with the process's start: the forecast needs both.
        run.costs.observe_scene(job.matches, seconds)
        text = f"{record.registered} of {plural(record.images, 'image')}"
        more = ""  # about a further candidate
        is_best = state.use_new_scene(job.batch, job.scene, record, is_filed=job.export is not None)
        if job.candidate != ALL_UNITS:
            outcome = "the best so far" if is_best else "not better"
            more = f" by the tracks of {title_of(job.candidate)}, {outcome}"
        run.log.note(EventKind.SCENE, f"{job.batch}: {text}{more}")

    def lose(self, job: SceneJob, failure: Failure) -> None:
        self._count_loss(job.batch, job.candidate, job.scene, failure, job.pairs)

    def _count_loss(
        self,
        batch: str,
        candidate: str,
        scene: str,
        failure: Failure,
        pairs: Sequence[PairInputs] = (),
    ) -> None:
        """Note that a candidate was lost, and give it up after the second time.

        ``scene`` is the key of the first candidate, ``pairs`` are those whose points a worker read.
        """
        run = self._run
        state = run.state
        tracks = ""
        if candidate != ALL_UNITS:
            tracks = f" from the tracks of {title_of(candidate)}"
        run.log.fault(f"batch {batch} was not reconstructed{tracks}: {failure}")
        state.scenes.end(batch, candidate)
        # A worker reads the store by itself. Another program may have damaged it.
        if run.forget_lost_points(pairs):
            return
        if state.tries.lose([("scene", batch, of_candidate(scene, candidate))], failure):
            state.scenes.give_up(batch, candidate, scene, state.tries.given_up)


def scene_records(state: State) -> tuple[SceneRecord, ...]:
    """Return the scene of each batch, in order; ``failure`` is the reason for a missing scene."""
    reasons = scene_failures(state)
    records = []
    for batch in state.batches:
        if batch in state.scenes.in_use:
            records.append(state.scenes.in_use[batch])
        elif batch in reasons:
            records.append(SceneRecord(batch, failure=str(reasons[batch])))
        elif state.is_unmatched(batch):
            names = {name for index in state.rows_of(batch) for name in state.names[index]}
            records.append(unmatched_scene(batch, names))
        else:
            records.append(SceneRecord(batch, failure=NOT_RECONSTRUCTED))
    return tuple(records)


def scene_failures(state: State) -> dict[str, Failure]:
    """Return why batches could not be reconstructed from today's results."""
    given_up = state.tries.given_up
    everywhere = given_up.get(("scenes",))
    found = {}
    for batch in state.batches:
        # Neither a failure on former inputs counts, nor one after the batch was done.
        failure = given_up.get(("scene", batch, state.scene_inputs(batch)[1]))
        if failure is None and batch in state.scenes.stale:
            failure = everywhere
        if failure is not None:
            found[batch] = failure
    return found
