"""The state of a run: arrays over pairs and units, updated from answers.

The state has, for each pair and unit, the key of the points in use, and whether that is today's key.
A stage-2 unit looks at crops that come from the pair's stage-1 points: new points of stage 1 change
its key, and its points are computed again; until then, the run uses the former ones. Of an earlier run,
whose results may not be today's, the state has the F that it wrote, and nothing else.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Cause, Failure, PairInputs
from mkpc_kaggle.engine.plan.blame import Item, Tries
from mkpc_kaggle.engine.plan.scene_state import SceneState
from mkpc_kaggle.engine.request import Request, batches_of, distinct_pairs, names_of, visiting_order
from mkpc_kaggle.engine.store.image_files import contents_of
from mkpc_kaggle.engine.store.keys import Images
from mkpc_kaggle.engine.store.tables import PairEstimate, SceneRecord, UnitPoints
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.robust import (
    FALLBACK_FUNDAMENTAL,
    MAX_THIRD,
    MAX_THIRD_OF_E,
    are_models,
)
from mkpc_kaggle.scene.candidates import ALL_UNITS, candidates_of
from mkpc_kaggle.scene.view_graph import BatchImage

Mask = NDArray[np.bool_]

# Where the F of a pair comes from. The scene's is preferred to the pair's own.
FALLBACK, PAIR, SCENE, EARLIER = 0, 1, 2, 3
SOURCES = ("fallback", "pair", "scene", "earlier")


class State:
    """Arrays for N distinct pairs and the U units of a recipe, in their order. The first ``rows`` pairs
    have a row in the request, or several: ``pair_of_row`` has the pair of each. The ``extra`` pairs
    after them are for scenes alone.

    Of a pair's units (N, U): ``points``, the keys of the points in use, "" if none; ``has``, there are some;
    ``current``, they are today's; ``matches``, their number; ``skipped``, this run tries the unit no more;
    ``unneeded``, the pair does not need the unit, whose key stands for no points.

    Of a pair (N,): ``estimates``, the key of the estimate in use; ``estimated``, it is today's;
    ``inliers``, the F ``own`` (N, 3, 3) and ``has_own``, it is no fallback. ``earlier`` (N, 3, 3) is the F
    in the last table of an earlier run, if ``has_earlier``, and ``earlier_by_scene``, if a scene gave it.
    ``matching`` and ``estimating`` are the pairs of jobs under way, and ``filling`` the pairs in the last phase.
    ``costly`` are pairs with a unit whose jobs were lost twice. ``by_scene`` (N, 3, 3) and
    ``scene_source`` are the F that the scene in use gives, if any.
    ``changed`` has the pairs with other results than in the last table of pairs.

    Of a batch: ``batches`` has its number by name, ``members`` its pairs; ``batch_of`` (N,) is -1 for a pair
    without one. ``scenes`` has the scenes in use, and the candidates to make.
    """

    def __init__(self, request: Request, extra: Sequence[Pair] = ()) -> None:
        self.request = request
        distinct, self.pair_of_row = distinct_pairs(request.pairs)
        self.pairs = [*distinct, *extra]
        self.rows = len(distinct)
        self.units = request.recipe.units
        self.number_of = {unit.name: number for number, unit in enumerate(self.units)}
        self.is_crop = np.array([unit.stage == 2 for unit in self.units], bool)
        # Relative to the root, so that a folder that moved keeps its results.
        self.names = [names_of(pair, request.root) for pair in self.pairs]
        # Pairs with a common image are visited together, since its encodings are cached.
        self.order = np.asarray(visiting_order(self.pairs), int)
        self.images: dict[str, BatchImage] = {}  # by name, once their contents are known
        self.tries = Tries()
        self._start_pairs(len(self.pairs), len(self.units))
        self._start_batches()
        # An E has a third singular value of rounding alone.
        is_f = [pair.intrinsics is None for pair in self.pairs]
        self.max_third = np.where(is_f, MAX_THIRD, MAX_THIRD_OF_E)
        self._pairs_of: dict[str, list[int]] = {}  # by the name of an image
        for index, names in enumerate(self.names):
            for name in dict.fromkeys(names):
                self._pairs_of.setdefault(name, []).append(index)

    def _start_pairs(self, count: int, units: int) -> None:
        size = (count, units)
        # Column by column: the schedule looks at one unit of all pairs at a time.
        self.points = np.full(size, "", object, order="F")
        self.matches = np.zeros(size, int, order="F")
        self.has = np.zeros(size, bool, order="F")
        self.current = np.zeros(size, bool, order="F")
        self.skipped = np.zeros(size, bool, order="F")
        self.unneeded = np.zeros(size, bool, order="F")
        self.estimates = np.full(count, "", object)
        self.own = np.tile(FALLBACK_FUNDAMENTAL, (count, 1, 1))
        self.estimated = np.zeros(count, bool)
        self.has_own = np.zeros(count, bool)
        self.earlier = np.zeros((count, 3, 3))
        self.has_earlier = np.zeros(count, bool)
        self.earlier_by_scene = np.zeros(count, bool)
        self.matching = np.zeros(count, bool)
        self.filling = np.zeros(count, bool)
        self.costly = np.zeros(count, bool)
        self.estimating = np.zeros(count, bool)
        self.inliers = np.zeros(count, int)
        self.by_scene = np.zeros((count, 3, 3))
        self.scene_source = np.full(count, FALLBACK)
        self.changed = set(range(count))
        self.lost_estimates: dict[int, Failure] = {}  # why the latest job of a pair was lost
        self._contents = [""] * count

    def _start_batches(self) -> None:
        batches: dict[str, list[int]] = {}
        if self.request.recipe.scene is not None:
            batches = batches_of(self.pairs)
        # A scene has no row in the arrays above, so batches have numbers for arrays over batches.
        self.batches = {name: number for number, name in enumerate(batches)}
        self.members = [np.asarray(members, int) for members in batches.values()]
        self.batch_of = np.full(len(self.pairs), -1)
        for number, members in enumerate(self.members):
            self.batch_of[members] = number
        candidates = candidates_of(self.units, self.request.recipe.scene)
        self.scenes = SceneState(batches, candidates, self.request.exports)

    # Results in use

    @property
    def missing(self) -> Mask:
        """(N, U): today's points are missing, and this run can get them."""
        return np.asarray(~self.current & ~self.skipped)

    @property
    def lacks_estimate(self) -> Mask:
        """(N,): the row's estimate is not from the points in use, and this run can get it."""
        lacking = self.has.any(1) & ~self.estimated
        lacking[self.rows :] = False  # extra pairs are for scenes alone
        for item in self.tries.given_up:
            match item:
                case ("estimate elsewhere", int(index)):
                    lacking[index] = False
                case ("estimates",):
                    lacking[:] = False
        return np.asarray(lacking)

    @property
    def need_shares(self) -> NDArray[np.float64]:
        """(U,): the expected share of the pairs that need a unit, 1 for a unit of stage 1.

        The share of the pairs that are known, and one more that needs it.
        """
        known = self.current[: self.rows].sum(0)
        needed = known - self.unneeded[: self.rows].sum(0)
        return np.asarray((needed + 1) / (known + 1))

    @property
    def fundamentals(self) -> NDArray[np.float64]:
        """The F to write (R, 3, 3) for each row of the request. The first that exists, by :attr:`sources`:

        - "earlier": the F of the last table of pairs, while it :attr:`stands_in`: no scene in use gives an F, and
          there is no estimate yet, or a scene gave this F and the batch awaits its scene of today;
        - "scene": the F of the pair's cameras, unless its matches contradict it
          (:func:`mkpc_kaggle.scene.choose.choose`);
        - "pair": the F of its matches; with ``[focal]``, and if the cameras of two different files give no F,
          at the focal lengths of the scene;
        - "fallback": a fixed matrix.
        """
        sources, written = self._written
        written[sources == FALLBACK] = FALLBACK_FUNDAMENTAL
        return written[self.pair_of_row]

    @property
    def sources(self) -> NDArray[np.int_]:
        """Where the F to write comes from (R,), for each row of the request."""
        sources, _ = self._written
        return sources[self.pair_of_row]

    @property
    def _written(self) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """The source (rows,) of the F of each pair with a row, and the matrices (rows, 3, 3)."""
        sources = np.where(self.has_own, PAIR, FALLBACK)
        written = self.own.copy()
        # A scene's F is more accurate: its cameras agree with all images of the batch.
        by_scene = self.scene_source != FALLBACK
        sources[by_scene] = self.scene_source[by_scene]
        written[by_scene] = self.by_scene[by_scene]
        stands_in = self.stands_in
        sources[stands_in] = EARLIER
        written[stands_in] = self.earlier[stands_in]
        # The last gate of the submission: the competition refuses a whole file for one matrix.
        sources[~are_models(written, self.max_third)] = FALLBACK
        return sources[: self.rows], written[: self.rows]

    @property
    def stands_in(self) -> Mask:
        """(N,): the F of an earlier run is written, since this run has none yet.

        The F of an earlier scene also stands in for the pair's own F, while the first scene of today is
        pending. An estimate that failed is today's result: nothing stands in for it.
        """
        lacks_estimate = self.estimates == ""
        awaits_better = self.earlier_by_scene & self._awaits_scene
        has_scene = self.scene_source != FALLBACK
        return np.asarray(self.has_earlier & ~has_scene & (lacks_estimate | awaits_better))

    @property
    def result_keys(self) -> list[str]:
        """The keys of all points and estimates in use."""
        return [key for key in (*self.points.ravel(), *self.estimates) if key]

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each image's content, by name."""
        # A copy first: the watchdog may publish while the loop adds images.
        return {name: image.digest for name, image in dict(self.images).items()}

    @property
    def complete(self) -> Mask:
        """(rows,): all units and the estimate are today's."""
        rows = slice(self.rows)
        return np.asarray(self.current[rows].all(1) & self.estimated[rows])

    def matches_of_batches(self) -> NDArray[np.int_]:
        """Return the number of matches (B,) of each batch."""
        # The first bin counts pairs without a batch.
        bins = self.batch_of + 1
        matches = self.matches.sum(1)
        found = np.bincount(bins, matches, minlength=len(self.batches) + 1)
        return found[1:].astype(int)

    def matches_of_candidate(self, batch: str, candidate: str) -> int:
        """Return the number of matches that make a candidate's tracks, about."""
        matches = self.matches[self.members[self.batches[batch]]]
        if candidate not in self.number_of:
            return int(matches.sum())
        return int(matches[:, self.number_of[candidate]].sum())

    # Keys of today

    def images_of(self, index: int) -> Images | tuple[()]:
        """Return both images of a pair, or an empty tuple if one is unknown yet."""
        name0, name1 = self.names[index]
        if name0 in self.images and name1 in self.images:
            return self.images[name0], self.images[name1]
        return ()

    def contents(self, index: int) -> str:
        """Return a text that identifies the contents of a pair's images; empty if one is unknown
        yet.
        """
        # Cached, since each key of a scene needs the contents of all its pairs.
        if not self._contents[index] and (images := self.images_of(index)):
            self._contents[index] = contents_of(images, self.pairs[index].turns)
        return self._contents[index]

    def first_stage(self, index: int) -> list[str]:
        """Return the keys of a pair's points of stage 1, if they are today's, in the recipe's
        order.
        """
        chosen = ~self.is_crop & self.current[index]
        return [key for key in self.points[index][chosen] if key]

    def key_of(
        self,
        index: int,
        unit: int,
        images: Images,
        first: Sequence[str],
        *,
        is_float32: bool = False,
    ) -> str:
        """Return today's key of a unit's points; ``first`` are the keys of stage 1.

        ``is_float32`` states that the unit ran in float32, even if the run was given another precision.
        """
        keys = self.request.keys
        pair = self.pairs[index]
        crops = keys.crops_of(first) if self.is_crop[unit] else []
        return keys.of_points(unit, pair, images, crops, is_float32=is_float32)

    def keys_of(self, index: int, unit: int, images: Images, first: Sequence[str]) -> list[str]:
        """Return the keys of points that are today's: in the given precision, then in float32.

        A last key of a crop, if a rule decides, is that of the answer that the pair does not need it.
        """
        keys = [
            self.key_of(index, unit, images, first, is_float32=is_float32)
            for is_float32 in (False, True)
        ]
        if self.is_crop[unit] and self.request.keys.rule:
            keys.append(self.request.keys.unneeded(keys[0]))
        return list(dict.fromkeys(keys))

    def keys_in_use(self, index: int) -> list[str]:
        """Return the keys of a pair's points in use, in the recipe's order."""
        return list(self.points[index][self.has[index]])

    def estimate_key(self, index: int) -> str:
        """Return the key of an estimate from the points in use."""
        return self.request.keys.of_estimate(self.pairs[index], self.keys_in_use(index))

    def scene_inputs(self, batch: str) -> tuple[list[int], str]:
        """Return the pairs of a batch that have points, and the key of a scene from them."""
        members = self.members[self.batches[batch]]
        # A pair without points adds nothing to a scene.
        has_points = self.has[members].any(1)
        indices = members[has_points].tolist()
        inputs = [
            [
                self.names[index],
                self.contents(index),
                self.keys_in_use(index),
                self.estimates[index],
            ]
            for index in indices
        ]
        return indices, self.request.keys.of_scene(inputs)

    def rows_of(self, batch: str) -> list[int]:
        """Return the rows of a batch, without its extra pairs."""
        members = self.members[self.batches[batch]]
        return [int(index) for index in members if index < self.rows]

    @property
    def _awaits_scene(self) -> Mask:
        """(N,): the scene of the pair's batch is still to be made."""
        awaits = np.zeros(len(self.pairs), bool)
        if ("scenes",) not in self.tries.given_up:
            matches = self.matches_of_batches()
            for batch in self.scenes.stale | self.scenes.reconstructing:
                number = self.batches[batch]
                # No scene is made of a batch without matches.
                awaits[self.members[number]] = matches[number] > 0
        return awaits

    def is_unmatched(self, batch: str) -> bool:
        """Return whether all units have run on the rows of a batch, and none found a match.

        No scene is made for this batch, and no further run would change that.
        """
        rows = self.rows_of(batch)
        return not (self.missing[rows].any() or self.matches[rows].any())

    def inputs_of(self, index: int) -> PairInputs:
        """Return the inputs of a pair's estimate, or of its batch's scene."""
        images = self.images_of(index)
        assert images
        keys = zip(self.units, self.points[index], self.has[index], strict=True)
        points = {unit: key for unit, key, is_used in keys if is_used}
        own = self.own[index] if self.has_own[index] else None
        return PairInputs(index, images, points, self.pairs[index].intrinsics, own)

    # Updates

    def use_images(self, images: Mapping[str, BatchImage]) -> None:
        """Use the images whose contents are known at the start, by name."""
        self.images.update(images)

    def use_earlier(self, index: int, F: Matrix3, *, is_by_scene: bool) -> None:
        """Use the F that an earlier run wrote, until the pair gets another one."""
        self.earlier[index] = F
        self.has_earlier[index] = True
        self.earlier_by_scene[index] = is_by_scene

    def use_points(self, index: int, unit: int, points: UnitPoints) -> None:
        """Use a unit's points of today; none if the pair does not need the unit."""
        self.points[index, unit] = points.key
        self.has[index, unit] = points.is_needed
        self.unneeded[index, unit] = not points.is_needed
        self.current[index, unit] = True
        self.matches[index, unit] = points.matches
        self.changed.add(index)

    def use_new_points(self, index: int, found: Sequence[UnitPoints]) -> None:
        """Use the points of an answer."""
        before = self.keys_in_use(index)
        for points in found:
            self.use_points(index, self.number_of[points.unit], points)
        # Units that the pair does not need change nothing.
        if self.keys_in_use(index) != before:
            self._note_points(index)

    def forget_points(self, keys: Set[str]) -> None:
        """Forget the points with these keys: their units are missing again."""
        has_key = np.isin(self.points, list(keys))
        for index in np.flatnonzero(has_key.any(1)).tolist():
            lost = has_key[index]
            self.points[index, lost] = ""
            self.matches[index, lost] = 0
            self.has[index, lost] = False
            self.current[index, lost] = False
            self._note_points(index)

    def _note_points(self, index: int) -> None:
        """Note that a pair has new points: its crops, its estimate and its scene may be outdated."""
        self._check_crops(index)
        self.estimated[index] = False
        self._note_change(index)

    def _check_crops(self, index: int) -> None:
        """Mark the points of stage 2 whose crops come from other points of stage 1 than today's."""
        images = self.images_of(index)
        if not images:
            return
        first = self.first_stage(index)
        for unit in np.flatnonzero(self.is_crop & self.current[index]).tolist():
            keys = self.keys_of(index, unit, images, first)
            self.current[index, unit] = self.points[index, unit] in keys

    def use_image(self, image: BatchImage) -> None:
        """Use an image as it was decoded. Drop all results of another content of its file."""
        known = self.images.get(image.name)
        if known is not None and known.digest != image.digest:
            for index in self._pairs_of[image.name]:
                self._drop_results(index)
        self.images[image.name] = image

    def _drop_results(self, index: int) -> None:
        self._contents[index] = ""
        self.points[index] = ""
        self.has[index] = False
        self.unneeded[index] = False
        self.current[index] = False
        self.matches[index] = 0
        self.estimates[index] = ""
        self.estimated[index] = False
        self.own[index] = FALLBACK_FUNDAMENTAL
        self.has_own[index] = False
        self.has_earlier[index] = False
        self.inliers[index] = 0
        self.scene_source[index] = FALLBACK
        self._note_change(index)

    def use_estimate(self, index: int, estimate: PairEstimate) -> None:
        """Use an estimate. It is today's if it is from the points in use."""
        self.estimates[index] = estimate.key
        self.estimated[index] = estimate.key == self.estimate_key(index)
        self.own[index] = estimate.F
        self.has_own[index] = not estimate.failure
        self.inliers[index] = sum(estimate.inliers.values())

    def use_new_estimate(self, index: int, estimate: PairEstimate) -> None:
        """Use the estimate of an answer, even if the pair has newer points meanwhile: the former
        estimate is older still.
        """
        self.lost_estimates.pop(index, None)
        # Without points, the store has lost the points of this estimate.
        if self.has[index].any():
            self.use_estimate(index, estimate)
            self.changed.add(index)
            self._note_change(index)

    def use_new_scene(
        self, batch: str, scene: str, record: SceneRecord, *, is_filed: bool = False
    ) -> bool:
        """Use the scene of an answer, even if it is stale: the former scene is older still. Return
        whether it is the best candidate.

        A further candidate is used only if it is from the results in use, as the first one with the
        key ``scene``. ``is_filed`` states that the batch's folder has its files.
        """
        scenes = self.scenes
        if is_filed:
            scenes.note_files(batch, record.key)
        scenes.end(batch, record.candidate)
        if record.candidate == ALL_UNITS:
            self.use_candidate(batch, record)
            # Otherwise pairs have got other results meanwhile, and the batch stays stale.
            if self.scene_inputs(batch)[1] == record.key:
                scenes.settle(batch, self.tries.given_up)
        elif scenes.is_of_today(batch, scene):
            self.use_candidate(batch, record)
            scenes.try_others(batch, self.tries.given_up)
        else:
            return False
        return scenes.best_candidate(batch) == record.candidate

    def use_candidate(self, batch: str, record: SceneRecord) -> None:
        """Use a candidate of a scene, if it is the best one so far: pairs with a choice take its F."""
        scene = self.scenes.use(batch, record)
        members = self.members[self.batches[batch]]
        self.changed.update(members.tolist())
        self.earlier_by_scene[members] = (
            False  # pairs without any F of today keep their earlier one
        )
        self.scene_source[members] = FALLBACK  # of the former scene
        for index in members.tolist():
            choice = scene.choices.get(self.contents(index))
            if choice is not None and choice.F is not None:
                self.by_scene[index] = choice.F
                # F at the scene's focal lengths is still the pair's own.
                self.scene_source[index] = SCENE if choice.from_scene else PAIR

    def _note_change(self, index: int) -> None:
        """Note that a pair has other inputs for its scene than before: points, or an estimate."""
        self.changed.add(index)
        if self.batch_of[index] >= 0:
            self.scenes.note_change(self.pairs[index].group)

    def take_changed(self) -> list[int]:
        """Return the pairs that have changed since the last call."""
        changed = sorted(self.changed)
        self.changed.clear()
        return changed

    # Jobs and failures

    def begin_matching(self, indices: Iterable[int], *, is_filling: bool = False) -> None:
        """Note the pairs of a job under way."""
        self.matching[list(indices)] = True
        if is_filling:
            self.filling[list(indices)] = True

    def end_matching(self, indices: Iterable[int]) -> None:
        self.matching[list(indices)] = False
        self.filling[list(indices)] = False

    def begin_estimates(self, indices: Iterable[int]) -> None:
        self.estimating[list(indices)] = True

    def end_estimates(self, indices: Iterable[int]) -> None:
        self.estimating[list(indices)] = False

    def lose_estimates(self, indices: Iterable[int], failure: Failure) -> None:
        """Note why the estimates of a job have no result."""
        for index in indices:
            self.lost_estimates[index] = failure
            self.changed.add(index)

    def give_up_estimates(self, failure: Failure) -> None:
        """Estimate no pair any more in this run."""
        for index in np.flatnonzero(self.lacks_estimate).tolist():
            self.lost_estimates.setdefault(index, failure)
            self.changed.add(index)
        self.tries.given_up["estimates",] = failure

    def give_up(self, item: tuple[Any, ...], failure: Failure) -> None:
        """Stop trying an item in this run. For the items see :mod:`mkpc_kaggle.engine.plan.blame`."""
        self.tries.given_up[item] = failure
        match item:
            case ("unit", index, unit):
                self.changed.add(index)
                self.skipped[index, self.number_of[unit]] = True
                # A matcher that raised costs no worker.
                if failure.cause is not Cause.UNIT_RAISED:
                    self.costly[index] = True
            case ("matcher", unit):
                # For all pairs, but told once: no row of the table gets this reason.
                self.skipped[:, self.number_of[unit]] = True
            case ("pair", index):
                self.changed.add(index)
                self.skipped[index] = True

    def forgive(self, lost: Iterable[frozenset[Item]]) -> int:
        """Forget the losses of a closed place. Return the number of items to try again."""
        taken_back = self.tries.forgive(lost)
        for item in taken_back:
            match item:
                case ("unit", int(index), str(unit)):
                    self.changed.add(index)
                    self.costly[index] = False
                    self._reconsider(unit)
        return len(taken_back)

    def _reconsider(self, unit: str) -> None:
        """Skip a unit on exactly the pairs that are still given up."""
        number = self.number_of[unit]
        given_up = self.tries.given_up
        everywhere = given_up.get(("matcher", unit))
        if everywhere is not None and everywhere.cause is Cause.REFUSED:
            return
        # It was skipped on all pairs because of losses, and some of these are forgiven.
        given_up.pop(("matcher", unit), None)
        self.skipped[:, number] = False
        for item in given_up:
            match item:
                case ("unit", int(index), name) if name == unit:
                    self.skipped[index, number] = True
                case ("pair", int(index)):
                    self.skipped[index, number] = True

    def given_up_units(self) -> Iterator[tuple[int, str]]:
        """Yield each pair and unit that was given up."""
        for item in self.tries.given_up:
            match item:
                case ("unit", int(index), str(unit)):
                    yield index, unit

    def forget_failures(self) -> None:
        """Forget the failures of the devices so far: another device takes over."""
        self.tries = self.tries.of_scenes()
        self.changed.update(range(len(self.pairs)))
        self.skipped[:] = False
        self.costly[:] = False
        # The jobs of killed workers never come back.
        self.matching[:] = False
        self.filling[:] = False

    @property
    def has_given_up(self) -> bool:
        """Whether a unit or an estimate was given up.

        Unreadable images and matchers that are left out are facts of the input.
        """
        kinds = ("unit", "matcher", "estimate elsewhere", "estimates")
        return any(
            item[0] in kinds and failure.cause is not Cause.REFUSED
            for item, failure in self.tries.given_up.items()
        )

    @property
    def unusable(self) -> Mask:
        """(U,): units that no worker can run."""
        given_up = self.tries.given_up
        return np.array([("matcher", unit.name) in given_up for unit in self.units], bool)
