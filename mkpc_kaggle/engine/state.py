"""The state of a run: arrays over pairs and units, read from the store once and updated from
answers.

A pair keeps the points and the F that it has until those of today's key exist. So for each pair and
unit the state has the key of the points in use, and whether that is today's key. A stage-2 unit
looks at crops that come from the pair's stage-1 points: new points of stage 1 change its key, and
its points are computed again.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import (
    Cause,
    Estimated,
    Failure,
    Outcome,
    PairInputs,
    SceneJob,
    Tries,
    visiting_order,
)
from mkpc_kaggle.engine.keys import Images
from mkpc_kaggle.engine.records import (
    Row,
    SceneRecord,
    Table,
    contents_of,
    image_results,
    known_images,
    region_to_json,
)
from mkpc_kaggle.engine.request import Request
from mkpc_kaggle.engine.store import Kind, Result, Store, to_bytes
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.scene.export import has_files
from mkpc_kaggle.scene.reconstruct import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

Mask = NDArray[np.bool_]

# Where the F of a pair comes from.
FALLBACK, PAIR, SCENE = 0, 1, 2
SOURCES = ("fallback", "pair", "scene")
EXPORT = "export "  # prefix of the keys of marks, which are names of batches


class State:
    """Arrays for N pairs and the U units of a recipe, in their order. The first ``rows`` pairs have
    a row.

    Of a pair's units (N, U): ``points``, the keys of the points in use, "" if none; ``has``, there are some;
    ``current``, they are today's; ``matches``, their number; ``skipped``, this run tries the unit no more.

    Of a pair (N,): ``estimates``, the key of the estimate in use; ``estimated``, it is today's;
    ``inliers``, the F ``own`` (N, 3, 3) and ``has_own``, it is no fallback. ``matching`` and
    ``estimating`` are the pairs of jobs under way, and ``filling`` those in the last phase.
    ``by_scene`` (N, 3, 3) and ``scene_source`` are the F that the scene in use gives, if any.

    Of a batch: ``batches`` has its number by name, ``members`` its pairs; ``batch_of`` (N,) is -1 for a pair
    without one. ``scenes`` has the scenes in use, ``stale`` the batches whose scene is not today's, and
    ``reconstructing`` those under way.
    """

    def __init__(
        self, request: Request, extra: Sequence[Pair], batches: Mapping[str, Sequence[int]]
    ) -> None:
        self.request = request
        self.pairs = [*request.pairs, *extra]
        self.rows = len(request.pairs)
        self.units = request.recipe.units
        self.number_of = {unit.name: number for number, unit in enumerate(self.units)}
        self.is_crop = np.array([unit.stage == 2 for unit in self.units], bool)
        # Relative to the root, so that a folder that moved keeps its results.
        self.names = [names_of(pair, request.root) for pair in self.pairs]
        # Pairs with a common image are visited together, since its encodings are cached.
        self.order = np.asarray(visiting_order(self.pairs), int)
        count = len(self.pairs)
        size = (count, len(self.units))
        # Column by column: the schedule looks at one unit of all pairs at a time.
        self.points = np.full(size, "", object, order="F")
        self.matches = np.zeros(size, int, order="F")
        self.has, self.current, self.skipped = (np.zeros(size, bool, order="F") for _ in range(3))
        self.estimates = np.full(count, "", object)
        self.own = np.tile(FALLBACK_FUNDAMENTAL, (count, 1, 1))
        self.estimated, self.has_own = (np.zeros(count, bool) for _ in range(2))
        self.matching, self.filling, self.estimating = (np.zeros(count, bool) for _ in range(3))
        self.inliers = np.zeros(count, int)
        self.by_scene = np.zeros((count, 3, 3))
        self.scene_source = np.full(count, FALLBACK)
        self.images: dict[str, BatchImage] = {}  # by name, once their contents are known
        self._contents = [""] * count
        self._rows: list[Row | None] = [None] * count  # of the table of pairs
        self._new = set(range(count))  # rows that have changed since the last table
        self.tries = Tries()
        # A batch's scene has no row of its own, so batches have numbers for arrays.
        self.batches = {name: number for number, name in enumerate(batches)}
        self.members = [np.asarray(members, int) for members in batches.values()]
        self.batch_of = np.full(count, -1)
        for number, members in enumerate(self.members):
            self.batch_of[members] = number
        self.scenes: dict[str, SceneRecord] = {}
        self.scene_keys: dict[str, str] = {}
        self.stale = set(batches)
        self.reconstructing: set[str] = set()
        # Rows with the same two images share their points and their estimate.
        alike: dict[Any, list[int]] = {}
        for index, pair in enumerate(self.pairs):
            # With other intrinsics, it is another model that is estimated.
            known = pair.intrinsics and tuple(K.tobytes() for K in pair.intrinsics)
            alike.setdefault((self.names[index], pair.turns, known), []).append(index)
        self._alike = [group for group in alike.values() if len(group) > 1]
        self._twins = {index: group for group in self._alike for index in group}
        self._pairs_of: dict[str, list[int]] = {}  # by the name of an image
        for index, names in enumerate(self.names):
            for name in dict.fromkeys(names):
                self._pairs_of.setdefault(name, []).append(index)

    # What the run has

    @property
    def missing(self) -> Mask:
        """(N, U): today's points are missing, and this run can get them."""
        return np.asarray(~self.current & ~self.skipped)

    @property
    def fundamentals(self) -> NDArray[np.float64]:
        """The F to write (rows, 3, 3): the scene's, else the pair's, else the fallback."""
        written = self.own[: self.rows].copy()
        chosen = self.scene_source[: self.rows] != FALLBACK
        written[chosen] = self.by_scene[: self.rows][chosen]
        return written

    @property
    def sources(self) -> NDArray[np.int_]:
        """Where the F to write comes from (rows,)."""
        own = np.where(self.has_own[: self.rows], PAIR, FALLBACK)
        return np.asarray(np.maximum(own, self.scene_source[: self.rows]))

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each image's content, by name."""
        return {name: image.digest for name, image in dict(self.images).items()}

    @property
    def complete(self) -> Mask:
        """(rows,): all units and the estimate are today's."""
        rows = slice(self.rows)
        return np.asarray(self.current[rows].all(1) & self.estimated[rows])

    def table(self) -> Table:
        """Return the table of pairs. Only rows that have changed since the last table are made
        anew.
        """
        sources = self.sources
        for index in self._new:
            source = SOURCES[sources[index]] if index < self.rows else ""
            self._rows[index] = self._row(index, source)
        self._new.clear()
        units = [(unit.name, unit.stage) for unit in self.units]
        rows = [row for row in self._rows if row is not None]
        scenes = dict(self.scene_keys)
        return Table(self.request.about, units, self.rows, rows, scenes, self.fundamentals)

    def _row(self, index: int, source: str) -> Row:
        pair = self.pairs[index]
        given_up = self.tries.given_up
        failures = {}
        for unit in self.units:
            failure = given_up.get(("unit", index, unit.name))
            if failure is not None and failure.cause is Cause.UNIT_RAISED:
                failures[unit.name] = failure.message
        points = self.points[index].tolist()
        reason = ""
        if unread := given_up.get(("pair", index)):
            reason = unread.message
        elif failures and not any(points):
            reason = next(iter(failures.values()))
        contents = self.contents(index)
        names = self.names[index]
        estimate = self.estimates[index]
        return Row(
            pair.id,
            pair.group,
            *names,
            *pair.turns,
            contents,
            points,
            estimate,
            source,
            failures,
            reason,
        )

    # Keys of today

    def images_of(self, index: int) -> Images | tuple[()]:
        """Return both images of a pair, or an empty tuple if one is unknown yet."""
        name0, name1 = self.names[index]
        if name0 in self.images and name1 in self.images:
            return self.images[name0], self.images[name1]
        return ()

    def first_stage(self, index: int) -> list[str]:
        """Return the keys of a pair's points of stage 1, if they are today's, in the recipe's
        order.
        """
        chosen = ~self.is_crop & self.current[index]
        return [key for key in self.points[index][chosen] if key]

    def key_of(self, index: int, unit: int, images: Images, first: Sequence[str]) -> str:
        """Return today's key of a unit's points; ``first`` are the keys of stage 1."""
        keys = self.request.keys
        pair = self.pairs[index]
        crops = keys.crops_of(pair, first) if self.is_crop[unit] else []
        return keys.of_points(unit, pair, images, crops)

    def estimate_key(self, index: int) -> str:
        """Return the key of an estimate from the points in use."""
        points = [key for key in self.points[index] if key]
        return self.request.keys.of_estimate(self.pairs[index], points)

    def scene_inputs(self, batch: str) -> tuple[list[int], str]:
        """Return the pairs of a batch that have points, and the key of a scene from them."""
        members = self.members[self.batches[batch]]
        indices = members[self.has[members].any(1)].tolist()
        inputs = [
            [
                self.names[index],
                self.contents(index),
                [key for key in self.points[index] if key],
                self.estimates[index],
            ]
            for index in indices
        ]
        return indices, self.request.keys.of_scene(inputs)

    def contents(self, index: int) -> str:
        """Return what identifies the contents of a pair's images; empty if one is unknown yet."""
        if not self._contents[index] and (images := self.images_of(index)):
            self._contents[index] = contents_of(images, self.pairs[index].turns)
        return self._contents[index]

    def matches_of_batches(self) -> NDArray[np.int_]:
        """Return the number of matches (B,) of each batch."""
        # The first place is for pairs of no batch.
        found = np.bincount(self.batch_of + 1, self.matches.sum(1), minlength=len(self.batches) + 1)
        return found[1:].astype(int)

    def inputs_of(self, index: int) -> PairInputs:
        """Return what an estimate or a scene is computed from."""
        images = self.images_of(index)
        assert images
        keys = zip(self.units, self.points[index], strict=True)
        points = {unit: key for unit, key in keys if key}
        own = self.own[index] if self.has_own[index] else None
        return PairInputs(index, images, points, self.pairs[index].intrinsics, own)

    # Reading the store, once

    def restore(self, store: Store, digests: Mapping[str, str]) -> None:
        """Find today's results, and those of the former table of pairs that stand in for missing
        ones.

        ``digests`` are those of the images' contents, by name, as far as they are known.
        """
        self.images = known_images(store, digests)
        former = Table.of(store)
        # By contents and not by id: another table may name the same two images.
        rows = {row.contents: row for row in former.rows if row.contents}
        known = [index for index in range(len(self.pairs)) if self.images_of(index)]
        old = {index: rows[self.contents(index)] for index in known if self.contents(index) in rows}
        self._restore_points(store, known, old, [name for name, _ in former.units])
        self._restore_estimates(store, known, old)
        self._restore_scenes(store, former, digests)

    def _restore_points(
        self, store: Store, known: list[int], old: Mapping[int, Row], units: list[str]
    ) -> None:
        # Stage 1 first, because the keys of stage 2 depend on it.
        for stage in (False, True):
            numbers = np.flatnonzero(self.is_crop == stage).tolist()
            today: dict[tuple[int, int], str] = {}
            for index in known:
                images = self.images_of(index)
                assert images
                first = self.first_stage(index) if stage else []
                for number in numbers:
                    today[index, number] = self.key_of(index, number, images, first)
            # Of a unit without points of today, the former points.
            others: dict[tuple[int, int], str] = {}
            for index, row in old.items():
                by_unit = dict(zip(units, row.points, strict=True))
                for number in numbers:
                    others[index, number] = by_unit.get(self.units[number].name, "")
            about = store.about([*today.values(), *filter(None, others.values())])
            for (index, number), key in today.items():
                is_current = key in about
                # Points of former settings are better than none.
                used = key if is_current else others.get((index, number), "")
                if used in about:
                    self._use_points(index, number, used, about[used]["matches"])
                    self.current[index, number] = is_current

    def _restore_estimates(self, store: Store, known: list[int], old: Mapping[int, Row]) -> None:
        today = {index: self.estimate_key(index) for index in known if self.has[index].any()}
        others = {index: row.estimate for index, row in old.items() if row.estimate}
        about = store.about([*today.values(), *others.values()])
        for index, key in today.items():
            self.estimated[index] = key in about
            # As long as the images are the same, the former F is better than the fallback.
            used = key if key in about else others.get(index, "")
            if used in about:
                self._use_estimate(index, used, about[used])

    def _restore_scenes(self, store: Store, former: Table, digests: Mapping[str, str]) -> None:
        today = {batch: self.scene_inputs(batch)[1] for batch in self.batches}
        about = store.about([*today.values(), *former.scenes.values()])
        exported = store.about(EXPORT + batch for batch in self.request.exports)
        for batch, key in today.items():
            used = key if key in about else former.scenes.get(batch, "")
            if used not in about:
                continue
            record = SceneRecord.of_json(about[used]["scene"])
            if directory := self.request.exports.get(batch):
                # The files belong to one scene, which a mark names.
                if exported.get(EXPORT + batch) != used:
                    continue
                if not has_files(directory, len(record.models)):
                    continue
            # A scene stands in for today's only while all of its images are as they were.
            contents = about[used]["digests"]
            if all(digests.get(name, content) == content for name, content in contents.items()):
                self.use_scene(batch, used, record)
                if used == key:
                    self.stale.discard(batch)

    # Answers

    def results_of(self, outcome: Outcome, crops: Sequence[str]) -> list[Result]:
        """Return the new results of a pair, and its images, as rows of the store. Changes the
        images alone.

        ``crops`` are the keys of the points of stage 1 that the job had.
        """
        index = outcome.index
        images = outcome.images
        if not images:
            return []
        results = []
        for image, file in zip(images, outcome.files, strict=True):
            known = self.images.get(image.name)
            # Most images are in many pairs, and are stored once.
            if known != image:
                results += image_results(image, file)
            if known is not None and known.digest != image.digest:
                self._replace(image)
            self.images[image.name] = image
        # If an image changed while the job ran, the crops come from points of its former content.
        are_valid = self.first_stage(index) == list(crops)
        first = {
            number: key
            for number, key in enumerate(self.points[index])
            if self.current[index, number] and not self.is_crop[number]
        }
        good = [found for found in outcome.found if not found.failure]  # failures are not stored
        for found in good:
            number = self.number_of[found.unit.name]
            if self.is_crop[number] and not are_valid:
                continue
            keys = [first[n] for n in sorted(first)]
            key = self.key_of(index, number, images, keys)
            # Units of stage 1 come first in an answer: those of stage 2 looked at crops from all of
            # them.
            if not self.is_crop[number]:
                first[number] = key
            regions = (outcome.regions or ()) if self.is_crop[number] else ()
            about = {
                "unit": found.unit.name,
                "matches": len(found.matches),
                "keypoints": found.keypoints,
                # The pair's own seconds are shared by the units of a job.
                "decode_seconds": outcome.decode_seconds / len(good),
                "cluster_seconds": outcome.cluster_seconds / len(good),
                "encode_seconds": found.encode_seconds,
                "match_seconds": found.match_seconds,
                "note": found.note,
                "regions": [region_to_json(region) for region in regions],
            }
            results.append(Result(key, Kind.POINTS, about, to_bytes(found.matches)))
        return results

    def take(self, outcome: Outcome, results: Iterable[Result]) -> None:
        """Use the points of an answer, on all rows with the same images."""
        points = [result for result in results if result.kind is Kind.POINTS]
        for index in self._twins.get(outcome.index, [outcome.index]):
            if outcome.failure:
                self.give_up(("pair", index), Failure(Cause.UNREADABLE, outcome.failure))
            for found in outcome.found:
                if found.failure:
                    failure = Failure(Cause.UNIT_RAISED, found.failure)
                    self.give_up(("unit", index, found.unit.name), failure)
            for result in points:
                number = self.number_of[result.about["unit"]]
                self._use_points(index, number, result.key, result.about["matches"])
            self._check_crops(index)
            # Another F, and another scene, can be computed now.
            if points:
                self.estimated[index] = False
                self._changed(index)

    def _use_points(self, index: int, number: int, key: str, matches: int) -> None:
        self.points[index, number] = key
        self.has[index, number] = self.current[index, number] = True
        self.matches[index, number] = matches

    def _check_crops(self, index: int) -> None:
        """Mark points of stage 2 whose crops come from other points of stage 1 than there are
        today.
        """
        images = self.images_of(index)
        if not images:
            return
        first = self.first_stage(index)
        for number in np.flatnonzero(self.is_crop & self.current[index]).tolist():
            key = self.key_of(index, number, images, first)
            self.current[index, number] = self.points[index, number] == key

    def _replace(self, image: BatchImage) -> None:
        """Forget what was computed from the former content of a file."""
        for index in self._pairs_of[image.name]:
            self._contents[index] = ""
            self.points[index] = ""
            self.has[index] = self.current[index] = False
            self.matches[index] = 0
            self.estimates[index] = ""
            self.estimated[index] = self.has_own[index] = False
            self.own[index] = FALLBACK_FUNDAMENTAL
            self.inliers[index] = 0
            self.scene_source[index] = FALLBACK
            self._changed(index)

    def estimate_result(self, each: Estimated) -> Result:
        """Return an estimate as a row of the store."""
        stats = each.stats
        about = {
            "points": each.points,
            "inliers": each.inliers,
            "F": each.F.ravel().tolist(),
            "magsac": None if each.magsac is None else each.magsac.ravel().tolist(),
            "failure": each.failure,
            "stats": {
                "candidates": stats.candidates,
                "cost": float(stats.cost),
                "magsac_cost": float(stats.magsac_cost),
                "focals": [float(focal) for focal in stats.focals],
                "support": float(stats.support),
                "rotation": [float(angle) for angle in stats.rotation],
            },
            "seconds": each.seconds,
        }
        key = self.request.keys.of_estimate(self.pairs[each.index], each.points)
        return Result(key, Kind.ESTIMATE, about)

    def take_estimate(self, each: Estimated, result: Result) -> None:
        """Use an estimate, even if its pair has newer points meanwhile: it is newer than the one
        before.
        """
        for index in self._twins.get(each.index, [each.index]):
            if self.has[index].any():  # its images are as they were
                self._use_estimate(index, result.key, result.about)
                self.estimated[index] = self.estimate_key(index) == result.key
                self._changed(index)

    def _use_estimate(self, index: int, key: str, about: Mapping[str, Any]) -> None:
        self.estimates[index] = key
        self.own[index] = np.array(about["F"]).reshape(3, 3)
        self.has_own[index] = not about["failure"]
        self.inliers[index] = sum(about["inliers"])

    def scene_result(self, job: SceneJob, answer: Solution, seconds: float) -> Result:
        """Return a scene as a row of the store."""
        record = SceneRecord.of_solution(job.batch, answer, job.contents, seconds)
        images = [image for pair in job.pairs for image in pair.images]
        digests = {image.name: image.digest for image in images}
        return Result(job.key, Kind.SCENE, {"scene": record.to_json(), "digests": digests})

    def use_scene(self, batch: str, key: str, record: SceneRecord) -> None:
        """Use a scene: pairs with a choice take its F."""
        self.scenes[batch] = record
        self.scene_keys[batch] = key
        members = self.members[self.batches[batch]]
        self._new.update(members.tolist())
        self.scene_source[members] = FALLBACK
        for index in members.tolist():
            choice = record.choices.get(self.contents(index))
            if choice is not None and choice.F is not None:
                self.by_scene[index] = choice.F
                # F at the scene's focal lengths is still the pair's own.
                self.scene_source[index] = SCENE if choice.from_scene else PAIR

    def _changed(self, index: int) -> None:
        """Note that a pair has other points, or another estimate, than before."""
        self._new.add(index)
        self.stale.update([self.pairs[index].group] if self.batch_of[index] >= 0 else [])

    # Jobs and failures

    def begin(self, under_way: Mask, indices: Iterable[int]) -> None:
        """Mark the pairs of a job, and the rows with the same images, as ``under_way``."""
        for index in indices:
            under_way[self._twins.get(index, [index])] = True

    def end(self, under_way: Mask, indices: Iterable[int]) -> None:
        for index in indices:
            under_way[self._twins.get(index, [index])] = False

    def give_up(self, item: tuple[Any, ...], failure: Failure) -> None:
        """Try an item no more in this run. For the items see :class:`Tries`."""
        self.tries.given_up[item] = failure
        match item:
            case ("unit", index, unit):
                self._new.add(index)
                self.skipped[self._twins.get(index, [index]), self.number_of[unit]] = True
            case ("matcher", unit):
                self.skipped[:, self.number_of[unit]] = True
            case ("pair", index):
                self._new.add(index)
                self.skipped[index] = True

    def given_up_units(self) -> Iterator[str]:
        """Yield the name of a unit for each pair that it was given up on."""
        for item in self.tries.given_up:
            match item:
                case ("unit", _, str(unit)):
                    yield unit

    def forget_failures(self) -> None:
        """Forget what the devices so far could not do: another one takes over."""
        self.tries = Tries()
        self._new.update(range(len(self.pairs)))
        self.skipped[:] = False
        self.matching[:] = self.filling[:] = False

    @property
    def unusable(self) -> Mask:
        """(U,): units that no worker can run."""
        return np.array(
            [("matcher", unit.name) in self.tries.given_up for unit in self.units], bool
        )


def names_of(pair: Pair, root: str) -> tuple[str, str]:
    """Return the paths of a pair's images below ``root``."""
    return name_below(root, pair.file0), name_below(root, pair.file1)


def name_below(root: str, file: str) -> str:
    """Return a file's path relative to ``root``, or the whole path if the file lies elsewhere."""
    return file.removeprefix(root.rstrip("/") + "/") if root else file
