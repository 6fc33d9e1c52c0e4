"""Matching: the schedule's jobs with their inputs, explained phases, results and losses."""

import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any

from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, MatchPlan, Outcome, Phase
from mkpc_kaggle.engine.plan.schedule import Crew, NextWork, outlook, upcoming_pairs
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.store.image_files import image_rows
from mkpc_kaggle.engine.store.rows import from_bytes, to_bytes
from mkpc_kaggle.engine.store.tables import UnitPoints
from mkpc_kaggle.pipeline.pair import UnitResult

# A unit that was given up on this number of pairs, and never ran, is skipped on all pairs.
MAX_FAILED_PAIRS = 2


class Matching:
    """Jobs that run units on a pair, or on a minibatch of pairs."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._shown: NextWork | None = None  # the phase of the bar, with its number of pairs
        self._explained = ""  # the phase that was explained last
        self._is_announced = False  # the outlook, once all costs were measured

    # Before a job

    def explain(self, work: NextWork, crew: Crew, now: float) -> None:
        """Explain a change of the phase or of the units that fit. Announce the outlook once it is
        measured.
        """
        run = self._run
        self._shown = work
        # During the sweep, only one cost is measured.
        if work.phase is Phase.SWEEP:
            return
        # In other phases, the number of units that fit changes with each pair.
        fitting = f"{work.phase} {work.fit if work.phase is Phase.DEEPEN else ''}"
        if fitting == self._explained and self._is_announced:
            return
        # Nothing is announced before it is measured.
        text = outlook(run.state, run.costs, run.budget, crew, now)
        if not text:
            fitting = f"{work.phase}, unmeasured"
        if fitting != self._explained:
            run.log.explain(f"{work.phase}: {text or 'not all units were measured yet'}")
            self._explained = fitting
        if text and not self._is_announced:
            run.progress.note(text)
            self._is_announced = True

    def forget(self) -> None:
        """Explain the phase again, since another device takes over."""
        self._explained = ""

    def job(self, plan: MatchPlan, minibatch: int) -> MatchJob | None:
        """Return the job of the schedule's plan: with its pairs, and the points that their crops come from.

        Return ``None`` if the points cannot be read: the job is lost then.
        """
        state = self._run.state
        if not plan.is_check:
            state.begin_matching(plan.indices, is_filling=plan.phase is Phase.FILL)
        # Units of stage 1 look at whole images and need no points.
        stage_1: list[tuple[UnitResult, ...]] = [()] * len(plan.indices)
        crops: list[tuple[str, ...]] = [()] * len(plan.indices)
        if any(unit.stage == 2 for unit in plan.units):
            # Crops come from points of today alone. Others may be of former settings.
            crops = [tuple(state.first_stage(index)) for index in plan.indices]
            inputs = list(zip(plan.indices, crops, strict=True))
            try:
                # The arrays of all points would not fit in memory.
                data = self._run.store.data(UnitPoints, {key for _, keys in inputs for key in keys})
            except sqlite3.Error as error:  # a disk that fails
                self.lose(plan, Failure(Cause.RAISED, f"the store cannot be read: {error}"))
                return None
            if self._run.forget_lost({key for _, keys in inputs for key in keys} - data.keys()):
                if plan.is_check:
                    state.tries.discard_proven(plan.items)
                else:
                    state.end_matching(plan.indices)
                return None
            stage_1 = [self._points_of(index, keys, data) for index, keys in inputs]
        upcoming: list[int] = []
        if not plan.is_check:
            # The others have these units, or another worker matches them.
            numbers = [state.number_of[unit.name] for unit in plan.units]
            missing = state.missing[:, numbers].any(1) & ~state.matching
            upcoming = upcoming_pairs(state, plan, minibatch, missing)
        return MatchJob(
            plan.phase,
            plan.indices,
            plan.units,
            plan.expected,
            plan.seconds,
            plan.is_last,
            plan.is_check,
            pairs=tuple(state.pairs[index] for index in plan.indices),
            names=tuple(state.names[index] for index in plan.indices),
            stage_1=tuple(stage_1),
            crops=tuple(crops),
            upcoming=tuple(path for index in upcoming for path in state.pairs[index].images),
        )

    def _points_of(
        self, index: int, keys: Sequence[str], data: Mapping[str, bytes]
    ) -> tuple[UnitResult, ...]:
        if not keys:
            return ()
        points = self._run.state.inputs_of(index).points
        units = {key: unit for unit, key in points.items()}
        return tuple(UnitResult(units[key], from_bytes(data[key])) for key in keys)

    # Answers

    def save(self, job: MatchJob, answer: Sequence[Outcome], seconds: float) -> None:
        if job.is_check:
            return
        run = self._run
        results = [
            self._results(index, outcome, crops)
            for index, outcome, crops in zip(job.indices, answer, job.crops, strict=True)
        ]
        # First the store, in one transaction: results in the state are never lost.
        run.store.put(result for rows in results for result in rows)
        run.state.end_matching(job.indices)
        for index, outcome, rows in zip(job.indices, answer, results, strict=True):
            self._use(index, outcome, rows)
            for unit_result in outcome.results:
                # A unit that raised says nothing about the time of one that runs.
                if unit_result.failure:
                    run.log.units_failed += 1
                    continue
                run.state.tries.succeed(("unit", index, unit_result.unit.name))
                # A unit that the pair does not need took no time.
                if unit_result.is_needed:
                    run.costs.observe(
                        unit_result.unit.name, unit_result.seconds, warm_up=unit_result.warm_up
                    )
                    run.log.units_run += 1
        if (work := self._shown) is not None:
            # The schedule counted the finished pairs before this answer. A pair whose other units
            # follow in another job counts after the last.
            done = work.done + len(job.indices) if job.is_last else work.done
            run.progress.count(str(work.phase), min(work.total, done), work.total)

    def _results(self, index: int, outcome: Outcome, crops: Sequence[str]) -> list[Any]:
        """Return the new points of a pair, and its images, as rows of the store.

        Changes the state's images alone. ``crops`` are the keys of the points of stage 1 that the
        job had.
        """
        state = self._run.state
        images = outcome.images
        if not images:
            return []
        # First, because the keys of the points depend on the images' contents.
        results = self._use_images(outcome)
        # If an image changed while the job ran, the crops come from points of its former content.
        are_valid = state.first_stage(index) == list(crops)
        # The keys of stage 1 by unit, since crops depend on them in the recipe's order.
        first = {
            number: key
            for number, key in enumerate(state.points[index])
            if state.current[index, number] and not state.is_crop[number]
        }
        # Failures are not stored: the next run tries them again.
        good = [unit_result for unit_result in outcome.results if not unit_result.failure]
        for unit_result in good:
            number = state.number_of[unit_result.unit.name]
            is_crop = state.is_crop[number]
            if is_crop and not are_valid:
                continue  # the unit stays missing and runs again
            keys = [first[n] for n in sorted(first)]
            is_float32 = unit_result.is_float32 and unit_result.is_needed
            key = state.key_of(index, number, images, keys, is_float32=is_float32)
            # An answer has stage 1 first: its units of stage 2 looked at crops from all of stage 1.
            if not is_crop:
                first[number] = key
            if not unit_result.is_needed:
                key = state.request.keys.unneeded(key)
            results.append(_points(key, unit_result, outcome, len(good)))
        return results

    def _use_images(self, outcome: Outcome) -> list[Any]:
        """Use the images of an answer, and return the new ones as rows of the store."""
        state = self._run.state
        results = []
        for image, file in zip(outcome.images, outcome.files, strict=True):
            # Most images are in many pairs, and are stored once.
            if state.images.get(image.name) != image:
                results += image_rows(image, file)
            state.use_image(image)
        return results

    def _use(self, index: int, outcome: Outcome, results: Sequence[Any]) -> None:
        """Use the points of an answer."""
        state = self._run.state
        points = [result for result in results if isinstance(result, UnitPoints)]
        # An unreadable image stays unreadable in this run, and a matcher that raised raises again.
        if outcome.failure:
            state.give_up(("pair", index), Failure(Cause.UNREADABLE, outcome.failure))
        for unit_result in outcome.results:
            if unit_result.failure:
                failure = Failure(Cause.UNIT_RAISED, unit_result.failure)
                state.give_up(("unit", index, unit_result.unit.name), failure)
        state.use_new_points(index, points)

    def lose(self, job: MatchPlan, failure: Failure) -> None:
        run = self._run
        state = run.state
        if job.is_check:
            # The next check is of another item: the points of this one may be unreadable.
            state.tries.discard_proven(job.items)
            return
        state.end_matching(job.indices)
        if not state.tries.lose(job.items, failure):
            return
        # Only a single item is given up.
        (index,) = job.indices
        name = job.units[0].name
        state.give_up(job.items[0], failure)
        run.log.explain(f"{name} is skipped on pair {index} ({failure})")
        # A unit that never ran on any pair would cost two workers for each.
        if not run.costs.mean(name) and self._fails_everywhere(name):
            state.give_up(("matcher", name), failure)
            run.log.explain(f"{name} is skipped on all pairs: it never ran ({failure})")

    def _fails_everywhere(self, name: str) -> bool:
        """Return whether a unit that never ran is at fault, and not its pairs."""
        state = self._run.state
        pairs = [index for index, unit in state.given_up_units() if unit == name]
        if len(pairs) < min(MAX_FAILED_PAIRS, len(state.pairs)):
            return False
        # The first pairs may be bad. A unit that fails where other units ran is not.
        return bool(state.has[pairs].any()) or not state.has.any()


def _points(key: str, found: UnitResult, outcome: Outcome, units: int) -> UnitPoints:
    """Return the points of one of the ``units`` of an answer."""
    need = found.need
    return UnitPoints(
        key,
        unit=found.unit.name,
        matches=len(found.matches),
        keypoints=found.keypoints,
        # The pair's own seconds are shared by the units of a job.
        decode_seconds=outcome.decode_seconds / units,
        cluster_seconds=outcome.cluster_seconds / units,
        encode_seconds=found.encode_seconds,
        match_seconds=found.match_seconds,
        note=found.note,
        regions=(outcome.regions or ()) if found.unit.stage == 2 else (),
        is_needed=found.is_needed,
        scale=None if need is None else need.scale,
        detail=None if need is None else need.detail,
        data=to_bytes(found.matches),
    )
