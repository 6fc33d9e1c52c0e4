"""The state of a run: arrays over pairs and units, updated from answers.

The order of the recipe is the order of the data: the crops of a unit of stage 2 come from the pair's points of the
units of stage 1 before it. A result is used only under today's key.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.keys import Images, contents_of, of_candidate
from mkpc_kaggle.engine.request import (
    EstimateJob,
    Job,
    MatchJob,
    PairInputs,
    Request,
    SceneJob,
    batches_of,
    distinct_pairs,
    names_of,
    visiting_order,
)
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.crop_need import pays
from mkpc_kaggle.geometry.robust import (
    FALLBACK_FUNDAMENTAL,
    are_models,
)
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.candidates import ALL_UNITS, best_of, candidates_of
from mkpc_kaggle.scene.densify import extra_pairs_of
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
# Losses of a unit on a pair, or of an estimate: an item that was lost this many times is given up. A matcher that
# raised raises again, and costs no worker.
GIVEN_UP, RAISED = 2, 3
ESTIMATE = -1  # the column of losses of estimates


class State:
    """Arrays for N distinct pairs and the U units of a recipe, in their order. The first ``rows`` pairs
    have a row in the request, or several: ``pair_of_row`` has the pair of each. The other pairs are for
    scenes alone.

    Of a pair's units (N, U): ``points``, the keys of the points in use; ``done``, today's answer is known;
    ``needed``, the pair needs the unit; ``matches``, their number. ``losses`` (N, U + 1) counts the lost jobs
    of each unit, and in the last column of the estimate.

    Of a pair (N,): ``estimate``, the key of the estimate in use; ``estimated``, it is today's; ``F`` (N, 3,
    3), its ``inliers`` and ``has_f``, it is no fallback; ``by_scene`` (N, 3, 3) and ``scene_source``, what
    the scene in use gives; ``unreadable``; ``busy``, the phase of a job under way, else ``NEVER``;
    ``estimating``; ``dirty``, other than in the last table of pairs. ``reasons`` has why a unit (by name),
    the estimate ("estimate") or the pair ("") failed.

    Of a unit (U,): ``unit_losses``, lost jobs of a unit that never ran; ``dead``, no worker runs it;
    ``refused`` has the reasons of those that cannot be loaded.

    Of a batch (B,), numbered by ``batches``: ``stale``, its scene is not today's; ``made``, its finished
    candidates from today's results by name; ``scene_losses`` and ``making`` by (batch, candidate).
    ``batch_of`` (N,) is -1 for a pair without one.
    """

    def __init__(
        self,
        request: Request,
        images: Mapping[str, BatchImage],
        unreadable: Mapping[str, str],
    ) -> None:
        self.request = request
        self.images = images
        distinct, self.pair_of_row = distinct_pairs(request.pairs)
        recipe = request.recipe
        extra = extra_pairs_of(request.pairs, batches_of(request.pairs), recipe.scene)
        self.pairs: list[Pair] = [*distinct, *extra]
        self.rows = len(distinct)
        self.units = recipe.units
        self.number_of = {unit.name: number for number, unit in enumerate(self.units)}
        self.is_crop = np.array([unit.stage == 2 for unit in self.units], bool)
        # Relative to the root, so that a folder that moved keeps its results.
        self.names = [names_of(pair, request.root) for pair in self.pairs]
        # Pairs with a common image are visited together, since its encodings are cached.
        self.order = np.asarray(visiting_order(self.pairs), int)
        self._start_pairs(len(self.pairs), len(self.units))
        self._start_batches()
        self.titles = [*self.number_of, "estimate"]  # of the columns of losses
        for index, names in enumerate(self.names):
            if reasons := [unreadable[name] for name in names if name in unreadable]:
                self.note_unreadable(index, reasons[0])

    def _start_pairs(self, count: int, units: int) -> None:
        size = (count, units)
        # Column by column: the plan looks at one unit of all pairs at a time.
        self.points = np.zeros(size, "S32", order="F")
        self.done = np.zeros(size, bool, order="F")
        self.needed = np.ones(size, bool, order="F")
        self.matches = np.zeros(size, np.int32, order="F")
        self.losses = np.zeros((count, units + 1), np.int8, order="F")
        self.estimate = np.zeros(count, "S32")
        self.estimated = np.zeros(count, bool)
        self.F = np.tile(FALLBACK_FUNDAMENTAL, (count, 1, 1))
        self.has_f = np.zeros(count, bool)
        self.inliers = np.zeros(count, np.int32)
        self.by_scene = np.zeros((count, 3, 3))
        self.scene_source = np.full(count, FALLBACK, np.int8)
        self.unreadable = np.zeros(count, bool)
        self.busy = np.full(count, NEVER, np.int8)
        self.estimating = np.zeros(count, bool)
        self.dirty = np.ones(count, bool)
        self.reasons: dict[int, dict[str, str]] = {}
        self.unit_losses = np.zeros(units, int)
        self.dead = np.zeros(units, bool)
        self.refused: dict[str, str] = {}  # by matcher

    def _start_batches(self) -> None:
        scene = self.request.recipe.scene
        batches = batches_of(self.pairs) if scene is not None else {}
        self.batches = {name: number for number, name in enumerate(batches)}
        self.members = [np.asarray(members, int) for members in batches.values()]
        self.batch_of = np.full(len(self.pairs), -1)
        for number, members in enumerate(self.members):
            self.batch_of[members] = number
        self.candidates = candidates_of(self.units, scene)
        self.stale = np.ones(len(batches), bool)
        self.made: list[dict[str, SceneRecord]] = [{} for _ in batches]
        self.scene_losses: Counter[tuple[int, str]] = Counter()
        self.scene_failures: dict[int, str] = {}
        self.making: set[tuple[int, str]] = set()

    # Results in use

    @property
    def missing(self) -> Mask:
        """(N, U): today's points are missing, and this run can get them."""
        open_units = ~self.dead & ~self.unreadable[:, None]
        return np.asarray(~self.done & (self.losses[:, :-1] < GIVEN_UP) & open_units)

    @property
    def used(self) -> Mask:
        """(N, U): the pair has points of the unit."""
        return np.asarray(self.done & self.needed)

    @property
    def lacks_estimate(self) -> Mask:
        """(N,): the row's estimate is not from the points in use, and this run can get it."""
        is_open = ~self.estimated & (self.losses[:, ESTIMATE] < GIVEN_UP)
        lacking = self.used.any(1) & is_open
        lacking[self.rows :] = False  # extra pairs are for scenes alone
        return np.asarray(lacking)

    @property
    def is_matching(self) -> bool:
        return bool((self.busy < NEVER).any())

    @property
    def sweep(self) -> int:
        """The number of the first unit that can run, of stage 1 if possible."""
        usable = np.flatnonzero(~self.dead).tolist()
        return min(usable, key=lambda unit: (self.is_crop[unit], unit), default=0)

    @property
    def complete(self) -> Mask:
        """(rows,): all units and the estimate are today's."""
        return np.asarray((self.done.all(1) & self.estimated)[: self.rows])

    @property
    def matches_of_batches(self) -> NDArray[np.int_]:
        """The number of matches (B,) of each batch."""
        # The first bin counts pairs without a batch.
        bins = self.batch_of + 1
        matches = self.matches.sum(1)
        return np.bincount(bins, matches, minlength=len(self.batches) + 1)[1:].astype(int)

    def matches_of_candidate(self, batch: int, candidate: str) -> int:
        """Return the number of matches that make a candidate's tracks, about."""
        matches = self.matches[self.members[batch]]
        if candidate in self.number_of:
            matches = matches[:, self.number_of[candidate]]
        return int(matches.sum())

    def batches_with(self, pairs: Mask) -> Mask:
        """Return the batches (B,) of these pairs (N,)."""
        found = np.zeros(len(self.batches), bool)
        numbers = self.batch_of[pairs]
        found[numbers[numbers >= 0]] = True
        return found

    @property
    def written(self) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """For each row of the request, the source (R,) of its F, and F (R, 3, 3); the first that exists:

        - the F of the pair's cameras, unless its matches contradict it (:func:`mkpc_kaggle.scene.choose.choose`);
        - the F of its matches; with ``[focal]``, and if the cameras of two different files give no F, at the focal
          lengths of the scene;
        - the fallback.
        """
        rows = slice(self.rows)
        by_scene = self.scene_source[rows] != FALLBACK
        sources = np.where(self.has_f[rows], PAIR, FALLBACK)
        sources[by_scene] = self.scene_source[rows][by_scene]
        matrices = np.where(by_scene[:, None, None], self.by_scene[rows], self.F[rows])
        # The last gate of the submission: the competition refuses a whole file for one matrix.
        sources[~are_models(matrices)] = FALLBACK
        matrices[sources == FALLBACK] = FALLBACK_FUNDAMENTAL
        return sources[self.pair_of_row], matrices[self.pair_of_row]

    @property
    def fundamentals(self) -> NDArray[np.float64]:
        """The F to write (R, 3, 3) for each row of the request."""
        return self.written[1]

    @property
    def scenes(self) -> dict[str, SceneRecord]:
        """The scene in use of each batch that has one."""
        return {
            batch: self.scene(number) for batch, number in self.batches.items() if self.made[number]
        }

    def scene(self, batch: int) -> SceneRecord:
        """Return the finished candidate with the smallest disagreement."""
        made = self.made[batch]
        named = {name: made[name].disagreement for name in self.candidates if name in made}
        return made[best_of(named)]

    def untried(self, batch: int) -> list[str]:
        """Return the further candidates of a batch that are missing, once its first is today's; of a stale
        batch all.
        """
        made = {} if self.stale[batch] else self.made[batch]
        return [
            name
            for name in self.candidates[1:]
            if name not in made and self.scene_losses[batch, name] < GIVEN_UP
        ]

    def may_make(self, batch: int) -> bool:
        """Return whether the first scene of a batch is missing, and may be made."""
        return bool(self.stale[batch]) and self.scene_losses[batch, ALL_UNITS] < GIVEN_UP

    def missing_scene(self, batch: str) -> str:
        """Return the reason why a batch has no scene."""
        number = self.batches[batch]
        rows = self.members[number][self.members[number] < self.rows]
        may_match = self.missing[rows].any() or self.matches[rows].any()
        return self.scene_failures.get(number, NOT_RECONSTRUCTED if may_match else NO_CAMERAS)

    @property
    def has_failures(self) -> bool:
        """Whether something was given up. Unreadable images and matchers that cannot be loaded are facts of the
        input.
        """
        refused = [unit.matcher in self.refused for unit in self.units]
        is_lost = bool((self.losses >= GIVEN_UP).any() or (self.dead & ~np.array(refused)).any())
        return is_lost or bool(self.scene_failures)

    # Keys of today

    def images_of(self, index: int) -> Images | tuple[()]:
        """Return both images of a pair, or an empty tuple if one is unknown."""
        name0, name1 = self.names[index]
        if name0 in self.images and name1 in self.images:
            return self.images[name0], self.images[name1]
        return ()

    def contents(self, index: int) -> str:
        """Return a text that identifies the contents of a pair's images."""
        return contents_of(self.images_of(index), self.pairs[index].turns)

    def key(self, index: int, unit: int) -> str:
        """Return today's key of a unit's points on a pair whose images are known."""
        images = self.images_of(index)
        assert images
        keys = self.request.keys
        first: list[str] = []
        if self.is_crop[unit]:
            first = [keys.mkpc, *self.points_before(index, unit).values()]
        return keys.of_points(unit, self.pairs[index], images, first)

    def points_before(self, index: int, unit: int) -> dict[Unit, str]:
        """Return the keys of the points of stage 1 that a unit's crops come from."""
        chosen = self.done[index, :unit] & ~self.is_crop[:unit]
        return self._keys(index, chosen)

    def _keys(self, index: int, chosen: Mask) -> dict[Unit, str]:
        """Return the keys of a pair's points of these units, in the recipe's order."""
        numbers = np.flatnonzero(chosen).tolist()
        return {self.units[number]: self.points[index, number].decode() for number in numbers}

    def keys_in_use(self, index: int) -> list[str]:
        """Return the keys of a pair's points in use, in the recipe's order."""
        return list(self._keys(index, self.done[index] & self.needed[index]).values())

    def estimate_key(self, index: int) -> str:
        """Return the key of an estimate from the points in use."""
        return self.request.keys.of_estimate(self.keys_in_use(index))

    def scene_inputs(self, batch: int) -> tuple[list[int], str]:
        """Return the pairs of a batch that have points, and the key of a scene from them."""
        members = self.members[batch]
        # A pair without points adds nothing to a scene.
        indices = members[self.used[members].any(1)].tolist()
        inputs = [
            [
                self.names[index],
                self.contents(index),
                self.keys_in_use(index),
                self.estimate[index].decode(),
            ]
            for index in indices
        ]
        return indices, self.request.keys.of_scene(inputs)

    def inputs_of(self, index: int) -> PairInputs:
        """Return the inputs of a pair's estimate, or of its batch's scene."""
        images = self.images_of(index)
        assert images
        points = self._keys(index, self.done[index] & self.needed[index])
        own = self.F[index] if self.has_f[index] else None
        return PairInputs(index, images, points, own)

    # Updates

    def restore(self, store: Store) -> None:
        """Use today's results of a store. It is the only time that it is read for the state."""
        known = [index for index in range(len(self.pairs)) if self.images_of(index)]
        # An extra pair has points of the sweeping unit, and no estimate. The store may have more, of another
        # recipe, or of a run in which it was a row, and a scene must not depend on that.
        rows = [index for index in known if index < self.rows]
        # In the recipe's order, because the keys of crops depend on it
        for unit in range(len(self.units)):
            self._restore_points(store, unit, known if unit == self.sweep else rows)
        keys = {index: self.estimate_key(index) for index in rows if self.used[index].any()}
        estimates = store.facts(keys.values())
        for index, key in keys.items():
            if key in estimates:
                self.use_estimate(index, key, json.loads(estimates[key]))
        for batch in range(len(self.batches)):
            self._restore_scenes(store, batch)

    def _restore_points(self, store: Store, unit: int, indices: Sequence[int]) -> None:
        mkpc = self.request.recipe.mkpc
        keys = {index: self.key(index, unit) for index in indices}
        columns = "key, matches, scale, detail, data IS NOT NULL"
        found = {key: row for key, *row in store.select("points", columns, keys.values())}
        for index, key in keys.items():
            if key not in found:
                continue
            matches, scale, detail, has_data = found[key]
            # Under another rule than today's, the pair may have needed the unit, or not.
            is_needed = not self.is_crop[unit] or pays(scale, detail, mkpc)
            if has_data or not is_needed:
                self.use_points(index, unit, key, matches, is_needed=is_needed)

    def _restore_scenes(self, store: Store, batch: int) -> None:
        _, first = self.scene_inputs(batch)
        folder = self.request.scenes_dir
        keys = {name: of_candidate(first, name) for name in self.candidates}
        # A scene without its folder is made again.
        keys = {
            name: key for name, key in keys.items() if folder is None or (folder / key).is_dir()
        }
        found = store.facts(keys.values())
        for name, key in keys.items():
            if key in found and (name == ALL_UNITS or not self.stale[batch]):
                self.use_scene(batch, SceneRecord.from_json(found[key]), first)

    def use_points(
        self, index: int, unit: int, key: str, matches: int, *, is_needed: bool = True
    ) -> None:
        """Use a unit's points of today. Later crops of the pair are open again after a unit of stage 1."""
        self.points[index, unit] = key.encode()
        self.done[index, unit] = True
        self.needed[index, unit] = is_needed
        self.matches[index, unit] = matches if is_needed else 0
        if not self.is_crop[unit]:
            later = np.flatnonzero(self.is_crop[unit + 1 :]) + unit + 1
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
        self.has_f[index] = not facts["failure"]
        self.inliers[index] = sum(facts["inliers"].values())
        self._note_change(index)

    def use_scene(self, batch: int, record: SceneRecord, first: str) -> None:
        """Use a candidate of a batch, whose first one has the key ``first``.

        The first candidate is used even if it is stale: the former scene is older still. Further ones are
        used only if they are from the same results, and today's.
        """
        made = self.made[batch]
        if record.candidate == ALL_UNITS:
            made.clear()
            self.stale[batch] = self.scene_inputs(batch)[1] != first
        elif self.stale[batch] or ALL_UNITS not in made or made[ALL_UNITS].key != first:
            return
        made[record.candidate] = record
        scene = self.scene(batch)
        members = self.members[batch]
        self.dirty[members] = True
        self.scene_source[members] = FALLBACK  # of the former scene
        for index in members.tolist():
            choice = scene.choices.get(self.contents(index))
            if choice is not None and choice.F is not None:
                self.by_scene[index] = choice.F
                # F at the scene's focal lengths is still the pair's own.
                self.scene_source[index] = SCENE if choice.from_scene else PAIR

    def _note_change(self, index: int) -> None:
        """Note that a pair has other inputs for its scene than before: points, or an estimate."""
        self.dirty[index] = True
        batch = self.batch_of[index]
        if batch >= 0:
            self.stale[batch] = True
            self.scene_failures.pop(int(batch), None)
            for name in self.candidates:
                del self.scene_losses[int(batch), name]

    # Jobs and failures

    def columns_of(self, job: MatchJob | EstimateJob) -> list[int]:
        """Return the columns of ``losses`` of a job."""
        if isinstance(job, EstimateJob):
            return [ESTIMATE]
        return [self.number_of[unit.name] for unit in job.units]

    def release(self, job: Job) -> None:
        """Note that a job is not under way any more."""
        if isinstance(job, MatchJob):
            self.busy[list(job.indices)] = NEVER
        elif isinstance(job, EstimateJob):
            self.estimating[job.indices] = False
        else:
            self.making.discard((self.batches[job.batch], job.candidate))

    def has_losses(self, job: Job) -> bool:
        """Return whether a pair of a job had a lost job of the same kind."""
        if isinstance(job, SceneJob):
            return False
        losses = self.losses[list(job.indices)]
        kind = losses[:, ESTIMATE] if isinstance(job, EstimateJob) else losses[:, :ESTIMATE]
        return bool(kind.any())

    def note_reason(self, index: int, what: str, reason: str) -> None:
        self.reasons.setdefault(index, {})[what] = reason
        self.dirty[index] = True

    def note_unreadable(self, index: int, reason: str) -> None:
        self.unreadable[index] = True
        self.note_reason(index, "", reason)

    def lose(self, job: MatchJob | EstimateJob, reason: str) -> list[tuple[int, str]]:
        """Count a lost job of its pairs. Return the pairs and units that are given up now."""
        given_up = []
        for index, unit in product(job.indices, self.columns_of(job)):
            if self.losses[index, unit] < GIVEN_UP:
                self.losses[index, unit] += 1
                if self.losses[index, unit] == GIVEN_UP:
                    given_up.append((index, self.titles[unit]))
                    self.note_reason(index, self.titles[unit], reason)
        return given_up

    def take_back(self, job: MatchJob | EstimateJob) -> None:
        """Forget a lost job of a place that was at fault."""
        for index, unit in product(job.indices, self.columns_of(job)):
            if 0 < self.losses[index, unit] <= GIVEN_UP:
                self.losses[index, unit] -= 1

    def refuse(self, refused: Mapping[str, str]) -> None:
        """Skip the units whose matchers cannot be loaded."""
        self.refused |= refused
        self.dead |= [unit.matcher in self.refused for unit in self.units]

    def lose_scene(self, batch: int, candidate: str, reason: str) -> None:
        """Count a lost job of a candidate."""
        self.scene_losses[batch, candidate] += 1
        if candidate == ALL_UNITS and not self.may_make(batch):
            self.scene_failures[batch] = reason

    def give_up_scenes(self, reason: str) -> None:
        """Note that no worker reconstructs any more."""
        for batch in np.flatnonzero(self.stale).tolist():
            self.scene_failures.setdefault(batch, reason)

    def begin_anew(self) -> None:
        """Forget the failures of the devices so far, and their jobs: another device takes over."""
        self.losses[:, :-1] = 0
        self.busy[:] = NEVER
        self.unit_losses[:] = 0
        self.dead[:] = False
        self.refused = {}
