"""The state of a run: arrays over pairs and units, updated from answers.

The order of the recipe is the order of the data: the crops of a unit of stage 2 come from the pair's points of the
units of stage 1 before it. A result is used only under today's key.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair, distinct_pairs, names_of, visiting_order
from mkpc_kaggle.engine.keys import Images, contents_of, of_candidate
from mkpc_kaggle.engine.request import Job, MatchJob, PairInputs, Request, SceneJob
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.crop_need import pays
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, is_fundamental
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.candidates import best_of, candidates_of
from mkpc_kaggle.scene.densify import batches_of, extra_pairs_of
from mkpc_kaggle.scene.records import NO_CAMERAS, NOT_RECONSTRUCTED, SceneRecord
from mkpc_kaggle.scene.view_graph import BatchImage

Mask = NDArray[np.bool_]

# Where the F of a pair comes from. The scene's is preferred to the pair's own.
FALLBACK, PAIR, SCENE = 0, 1, 2
SOURCES = ("fallback", "pair", "scene")
# Phases of matching, the most urgent first: the first unit of stage 1 that can run, on all pairs; the same unit on
# extra pairs, of batches with few pairs; the longest prefix of the recipe with enough time for all pairs; the
# remaining units, weakest pairs first; none, since the unit does not fit in the time left, or is done
SWEEP, CONNECT, DEEPEN, FILL, NEVER = range(5)
PHASES = ("sweep", "connect", "deepen", "fill", "never")
# Losses of a unit on a pair, of an estimate, or of a scene: an item that was lost this many times is given up. No
# losses: a matcher that raised raises again, and costs no worker; an unreadable image is a fact of the input.
GIVEN_UP, RAISED, UNREADABLE = 2, 4, 8
LOST = 3  # the bits of the number of losses
ESTIMATE = -1  # the column of losses of estimates
REFUSED = 1 << 30  # losses of a unit whose matcher cannot be loaded


class State:
    """Arrays for N distinct pairs and the U units of a recipe, in their order. The first ``rows`` pairs
    have a row in the request, or several: ``pair_of_row`` has the pair of each. The other pairs are for
    scenes alone.

    Of a pair's units (N, U): ``points``, the keys of the points in use; ``done``, today's answer is known;
    ``needed``, the pair needs the unit; ``matches``, their number. ``losses`` (N, U + 1) counts the lost jobs
    of each unit, and in the last column of the estimate.

    Of a pair (N,): ``estimate``, the key of the estimate in use; ``estimated``, it is today's; ``F`` (N, 3,
    3), its ``inliers`` and ``has_f``, it is no fallback; ``by_scene`` (N, 3, 3) and ``scene_source``, F
    by the scene in use; ``busy``, the phase of a job under way, else ``NEVER``; ``estimating``; ``dirty``,
    other than in the last table of pairs. ``reasons`` has why a unit (by name), the estimate ("estimate") or
    the pair ("") failed.

    Of a unit (U,): ``unit_losses``, lost jobs of a unit that never ran; ``dead``, no worker runs it.

    Of the B batches and C candidates of their scenes: ``made`` (B, C), the latest finished ones;
    ``scenes``, the one in use by batch (``best_of``); ``scene_losses`` (B, C); ``stale`` (B,),
    the scene is not today's; ``making``, (batch, candidate) under way. ``batch_of`` (N,) is -1 without a batch.
    """

    def __init__(self, request: Request, images: Mapping[str, BatchImage]) -> None:
        self.request = request
        self.images = images
        distinct, self.pair_of_row = distinct_pairs(request.pairs)
        recipe = request.recipe
        extra = extra_pairs_of(request.pairs, batches_of(request.pairs), recipe.scene)
        self.pairs: list[Pair] = [*distinct, *extra]
        self.rows = len(distinct)
        self.is_row = np.arange(len(self.pairs)) < self.rows
        self.units = recipe.units
        self.is_crop = np.array([unit.stage == 2 for unit in self.units], bool)
        # The units of stage 1 before each unit (U, U)
        self.before = np.tri(len(self.units), k=-1, dtype=bool) & ~self.is_crop
        # Relative to the root, so that a folder that moved keeps its results.
        self.names = [names_of(pair, request.root) for pair in self.pairs]
        # Pairs with a common image are visited together, since its encodings are cached.
        self.order = np.asarray(visiting_order(self.pairs), int)
        self._start_pairs(len(self.pairs), len(self.units))
        self._start_batches()
        # Of the columns of losses
        self.titles = [*(unit.name for unit in self.units), "estimate"]

    def _start_pairs(self, count: int, units: int) -> None:
        # Column by column: the plan looks at one unit of all pairs at a time.
        self.points = np.zeros((units, count), "S32").T
        self.done = np.zeros((units, count), bool).T
        self.needed = ~self.done
        self.matches = np.zeros((units, count), np.int32).T
        self.losses = np.zeros((units + 1, count), np.int8).T
        self.estimate = np.zeros(count, "S32")
        self.estimated = np.zeros(count, bool)
        self.F = np.tile(FALLBACK_FUNDAMENTAL, (count, 1, 1))
        self.has_f = np.zeros(count, bool)
        self.inliers = np.zeros(count, np.int32)
        self.by_scene = self.F.copy()
        self.scene_source = np.full(count, FALLBACK, np.int8)
        self.busy = np.full(count, NEVER, np.int8)
        self.estimating = np.zeros(count, bool)
        self.dirty = np.ones(count, bool)
        self.reasons: dict[int, dict[str, str]] = {}
        self.unit_losses = np.zeros(units, int)
        self.dead = np.zeros(units, bool)

    def _start_batches(self) -> None:
        scene = self.request.recipe.scene
        batches = batches_of(self.pairs) if scene is not None else {}
        self.batches = {name: number for number, name in enumerate(batches)}
        self.batch_of = np.array(
            [self.batches.get(pair.group, -1) for pair in self.pairs], int
        )
        # The pairs of all batches, one batch after the other, and where each begins
        self.members = np.hstack([[], *batches.values()]).astype(int)
        self.starts = self.batch_of[self.members].searchsorted(range(len(batches)))
        self.candidates = candidates_of(self.units, scene)
        size = (len(batches), len(self.candidates))
        self.made = np.full(size, None, object)  # of SceneRecord
        self.scenes: dict[str, SceneRecord] = {}
        self.scene_losses = np.zeros(size, np.int8)
        self.stale = np.ones(len(batches), bool)
        self.scene_failures: dict[int, str] = {}
        self.making: set[tuple[int, int]] = set()

    # Results in use

    @property
    def missing(self) -> Mask:
        """(N, U): today's points are missing, and this run can get them."""
        missing = ~self.done & (self.losses[:, :-1] < GIVEN_UP)
        missing[:, self.dead] = False
        return missing

    @property
    def used(self) -> Mask:
        """(N, U): the pair has points of the unit."""
        return self.done & self.needed

    @property
    def lacks_estimate(self) -> Mask:
        """(N,): the row's estimate is not from the points in use, and this run can get it."""
        # Extra pairs are for scenes alone.
        is_open = self.is_row & ~self.estimated & (self.losses[:, ESTIMATE] < GIVEN_UP)
        return is_open & self.used.any(1)

    @property
    def is_suspect(self) -> Mask:
        """(N,): a job of the pair was lost, and may be lost again."""
        return np.asarray((self.losses[:, :ESTIMATE] & LOST).any(1))

    @property
    def sweep(self) -> int:
        """The number of the first unit that can run, of stage 1 if possible."""
        return int(np.argmin(self.is_crop + 2 * self.dead))

    def by_batch(self, values: NDArray[Any]) -> NDArray[np.int_]:
        """Return the sum of each batch (B,) over its pairs' values (N,)."""
        return np.add.reduceat(values[self.members], self.starts, dtype=int)

    @property
    def scene_matches(self) -> NDArray[np.int_]:
        """The number of matches (B, C) that make a candidate's tracks, about."""
        columns = dict(zip(self.titles[:-1], self.matches.T, strict=True))
        every = self.matches.sum(1, np.int32)
        counts = [self.by_batch(columns.get(name, every)) for name in self.candidates]
        return np.transpose(counts)

    @property
    def missing_scenes(self) -> Mask:
        """(B, C): the candidate is not from today's results, and this run can get it."""
        # Without the first candidate, others have nothing to compare with.
        is_open = (self.scene_losses < GIVEN_UP) & (self.scene_losses[:, :1] < GIVEN_UP)
        return np.asarray((self.stale[:, None] | ~self.made.astype(bool)) & is_open)

    @property
    def written(self) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """For each row of the request, the source (R,) of its F, and F (R, 3, 3); the first that exists:

        - the F of the pair's cameras, unless its matches contradict it (:func:`mkpc_kaggle.scene.choose.choose`);
        - the F of its matches; with ``[focal]``, and if the cameras of two different files give no F, at the focal
          lengths of the scene;
        - the fallback.
        """
        by_scene = self.scene_source != FALLBACK
        sources = np.where(by_scene, self.scene_source, np.where(self.has_f, PAIR, FALLBACK))
        matrices = np.where(by_scene[:, None, None], self.by_scene, self.F)
        matrices[sources == FALLBACK] = FALLBACK_FUNDAMENTAL
        return sources[self.pair_of_row], matrices[self.pair_of_row]

    @property
    def scene_reasons(self) -> list[str]:
        """Why each batch (B,) has no scene, if it has none."""
        may_match = self.is_row & (self.missing | (self.matches > 0)).any(1)
        reasons = np.where(self.by_batch(may_match), NOT_RECONSTRUCTED, NO_CAMERAS)
        return [
            self.scene_failures.get(batch, why) for batch, why in enumerate(reasons.tolist())
        ]

    @property
    def has_failures(self) -> bool:
        """Whether something was given up. Unreadable images and matchers that cannot be loaded are facts of the
        input.
        """
        is_lost = np.isin(self.losses, (GIVEN_UP, RAISED))
        is_dead = self.dead & (self.unit_losses < REFUSED)
        return bool(is_lost.any() or is_dead.any() or self.scene_failures)

    # Keys of today

    def images_of(self, index: int) -> Images:
        name0, name1 = self.names[index]
        return self.images[name0], self.images[name1]

    def contents(self, index: int) -> str:
        """Return a text that identifies the contents of a pair's images."""
        return contents_of(self.images_of(index), self.pairs[index].turns)

    def key(self, index: int, unit: int) -> str:
        """Return today's key of a unit's points on a pair."""
        keys = self.request.keys
        before = self.points_of(index, self.before[unit]).values()
        first = [keys.mkpc, *before] if self.is_crop[unit] else []
        return keys.of_points(unit, self.pairs[index], self.images_of(index), first)

    def points_of(self, index: int, units: Mask | bool = True) -> dict[Unit, str]:
        """Return the keys of a pair's points in use, by default of all units (U,), in the recipe's order."""
        numbers = np.flatnonzero(units & self.done[index] & self.needed[index]).tolist()
        return {self.units[number]: self.points[index, number].decode() for number in numbers}

    def estimate_key(self, index: int) -> str:
        """Return the key of an estimate from the points in use."""
        return self.request.keys.of_estimate(self.points_of(index).values())

    def inputs_of(self, index: int, units: Mask | bool = True) -> PairInputs:
        """Return the inputs of a pair's job, with the points in use of these units (U,)."""
        return PairInputs(
            index,
            self.pairs[index],
            self.images_of(index),
            self.points_of(index, units),
            self.F[index] if self.has_f[index] else None,
        )

    def scene_inputs(self, batch: int) -> tuple[tuple[PairInputs, ...], str]:
        """Return the pairs of a batch that have points, and the key of a scene from them."""
        # A pair without points adds nothing to a scene.
        used = (self.batch_of == batch) & self.used.any(1)
        pairs = tuple(map(self.inputs_of, np.flatnonzero(used).tolist()))
        facts = [
            [
                *self.names[each.index],
                self.contents(each.index),
                [*each.points.values()],
                self.estimate[each.index].decode(),
            ]
            for each in pairs
        ]
        return pairs, self.request.keys.of_scene(facts)

    # Updates

    def restore(self, store: Store) -> None:
        """Use today's results of a store. It is the only time that it is read for the state."""
        columns = "key, matches, scale, detail, data IS NOT NULL"
        # In the recipe's order, because the keys of crops depend on it. An extra pair has points of the sweeping
        # unit. The store may have more, of another recipe, or of a run in which it was a row, and a scene must not
        # depend on that.
        for unit, crop in enumerate(self.is_crop.tolist()):
            count = len(self.pairs) if unit == self.sweep else self.rows
            keys = {index: self.key(index, unit) for index in range(count)}
            stored = {
                key: row for key, *row in store.select("points", columns, keys.values())
            }
            for index, key in keys.items():
                matches, scale, detail, has_data = stored.get(key, (0, 0.0, 0.0, None))
                # Under another rule than today's, the pair may have needed the unit, or not.
                is_needed = not crop or pays(scale, detail, self.request.recipe.mkpc)
                if has_data is not None and (has_data or not is_needed):
                    self.use_points(index, unit, key, matches, is_needed=is_needed)
        used = np.flatnonzero(self.used[: self.rows].any(1)).tolist()
        keys = {index: self.estimate_key(index) for index in used}
        estimates = store.facts(keys.values())
        for index, key in keys.items():
            if key in estimates:
                self.use_estimate(index, key, json.loads(estimates[key]))
        folder = self.request.scenes_dir
        for batch in self.batches.values():
            _, first = self.scene_inputs(batch)
            scenes = [of_candidate(first, name) for name in self.candidates]
            records = store.facts(scenes)
            for key in scenes:
                # A scene without its folder is made again.
                if key in records and (folder is None or (folder / key).is_dir()):
                    self.use_scene(batch, SceneRecord.from_json(records[key]))

    def use_points(
        self, index: int, unit: int, key: str, matches: int, *, is_needed: bool = True
    ) -> None:
        """Use a unit's points of today. Later crops of the pair are open again after a unit of stage 1."""
        self.points[index, unit] = key.encode()
        self.done[index, unit] = True
        self.needed[index, unit] = is_needed
        self.matches[index, unit] = matches if is_needed else 0
        self.losses[index, unit] = 0
        later = self.before[:, unit] & self.is_crop
        self.done[index, later] = False
        self.matches[index, later] = 0
        self.dirty[index] = True
        if is_needed:
            self.estimated[index] = False
            self._note_change(index)

    def use_estimate(self, index: int, key: str, facts: Mapping[str, Any]) -> None:
        """Use an estimate, which is today's if it is from the points in use."""
        self.estimate[index] = key.encode()
        self.estimated[index] = key == self.estimate_key(index)
        self.F[index] = np.reshape(facts["F"], (3, 3))
        # The competition refuses a whole file for one matrix of another rank.
        self.has_f[index] = not facts["failure"] and is_fundamental(self.F[index])
        self.inliers[index] = sum(facts["inliers"].values())
        self.losses[index, ESTIMATE] = 0
        self._note_change(index)

    def use_scene(self, batch: int, record: SceneRecord) -> None:
        """Use a candidate of a batch.

        The first candidate is used even if it is stale: the former scene is older still. Further ones are
        used only if they are from the same results, and today's.
        """
        made = self.made[batch]
        number = self.candidates.index(record.candidate)
        if not number:
            made[:] = None
            self.stale[batch] = self.scene_inputs(batch)[1] != record.key
        elif self.stale[batch] or record.key != of_candidate(made[0].key, record.candidate):
            return
        made[number] = record
        finished = {each.candidate: each.disagreement for each in made if each is not None}
        # Under today's name: a folder that was renamed keeps its results.
        scene = made[self.candidates.index(best_of(finished))]
        self.scenes[list(self.batches)[batch]] = scene
        members = np.flatnonzero(self.batch_of == batch)
        self.dirty[members] = True
        self.scene_source[members] = FALLBACK  # of the former scene
        for index in members.tolist():
            choice = scene.choices.get(self.contents(index))
            if choice is not None and choice.F is not None and is_fundamental(choice.F):
                self.by_scene[index] = choice.F
                # F at the scene's focal lengths is still the pair's own.
                self.scene_source[index] = SCENE if choice.from_scene else PAIR

    def _note_change(self, index: int) -> None:
        """Note that a pair has other inputs for its scene than before: points, or an estimate."""
        self.dirty[index] = True
        batch = int(self.batch_of[index])
        if batch >= 0:
            self.stale[batch] = True
            self.scene_losses[batch] = 0
            self.scene_failures.pop(batch, None)

    # Jobs and failures

    def release(self, job: Job) -> None:
        """Note that a job is not under way any more."""
        if isinstance(job, MatchJob):
            self.busy[job.indices] = NEVER
        elif isinstance(job, SceneJob):
            self.making.discard(job.scene)
        else:
            self.estimating[job.indices] = False

    def note_reason(self, index: int, what: str, reason: str) -> None:
        self.reasons.setdefault(index, {})[what] = reason
        self.dirty[index] = True

    def has_losses(self, job: Job) -> bool:
        """Return whether a pair of a job had a lost job of the same kind."""
        columns = slice(ESTIMATE) if isinstance(job, MatchJob) else ESTIMATE
        return bool((self.losses[job.indices, columns] & LOST).any())

    def cells(self, job: Job) -> tuple[NDArray[np.intp], ...]:
        """Return the cells of ``losses`` of a job of pairs."""
        columns = job.plan.units if isinstance(job, MatchJob) else [len(self.units)]
        return np.ix_(job.indices, columns)

    def lose(self, job: Job, reason: str) -> None:
        """Count a lost job of its pairs."""
        cells = self.cells(job)
        self.losses[cells] += self.losses[cells] < GIVEN_UP
        for index in job.indices:
            for column in cells[1].ravel().tolist():
                if self.losses[index, column] == GIVEN_UP:
                    self.note_reason(index, self.titles[column], reason)

    def take_back(self, job: Job) -> None:
        """Forget a lost job of a place that was at fault."""
        losses = self.losses[cells := self.cells(job)]
        self.losses[cells] -= (losses > 0) & (losses <= GIVEN_UP)

    def begin_anew(self) -> None:
        """Forget the failures of the devices so far, and their jobs: another device takes over."""
        losses = self.losses[:, :ESTIMATE]
        losses[losses < UNREADABLE] = 0
        self.busy[:] = NEVER
        self.unit_losses[:] = 0
        self.dead[:] = False
