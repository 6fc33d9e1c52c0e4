"""Batches reconstructed beside matching: which of them, when, and for how long.

A batch is due when all of its pairs are matched as far as time allows, and again when they have further matches
since. Pairs have the F of their own matches all the while.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import SceneJob
from mkpc_kaggle.engine.places import START_TIMEOUT_S
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Recipe, SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

MIN_PAIRS = 2  # they can connect three images
MAX_TRIES = 2  # of a reconstruction that is lost
START_S = 3.0  # that a process takes to begin
START_SHARE = 0.25  # of the time left, after which a process that has not begun hangs
MATCH_S = 5e-4  # that a match adds to a reconstruction, as long as nothing is known
FORECAST_MARGIN = 1.5  # a reconstruction may take this many times what its matches took in earlier scenes
HANG_FACTOR = 10.0  # a reconstruction, or a start, that takes this many times its forecast hangs
HANG_SHARE, MAX_HANG_S = 0.1, 3600.0  # of the time left that a reconstruction may take whatever was forecast
NOT_RECONSTRUCTED = "not reconstructed in time"


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """By batch, the indices of the pairs that may be reconstructed: F is wanted, and no camera is known."""
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Pairs of images of a batch that no row names, to be matched for its scene alone; the most wanted first.

    Each batch gets as many as it lacks to have ``pairs_per_image``, a batch with the fewest an image first.
    """
    if config is None or not config.pairs_per_image:
        return []
    extra: list[tuple[float, Pair]] = []
    for batch, indices in batches_of(pairs).items():
        asked = [pairs[index] for index in indices]
        files = list(dict.fromkeys(file for pair in asked for file in (pair.file0, pair.file1)))
        number = {file: index for index, file in enumerate(files)}
        ends = [(number[pair.file0], number[pair.file1]) for pair in asked]
        distinct = len({tuple(sorted(pair)) for pair in ends})
        for count, (i, j) in enumerate(extra_pairs(len(files), ends, config.pairs_per_image), start=distinct):
            key = f"{batch};{Path(files[i]).stem}-{Path(files[j]).stem}"
            extra.append((count / len(files), Pair(key, batch, files[i], files[j])))
    return [pair for _, pair in sorted(extra, key=lambda each: each[0])]


class Scenes:
    """What came of each batch of a run so far, and which is due; ``records`` are those of all pairs, by index.

    ``exports`` says of which batches COLMAP's files are written.
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        recipe: Recipe,
        records: Sequence[PairRecord],
        made: Iterable[SceneRecord],
        exports: Mapping[str, Export] = MappingProxyType({}),
    ) -> None:
        # Where files of a scene were removed, it is made again.
        self.made = {
            scene.batch: scene
            for scene in made
            if scene.batch not in exports or exports[scene.batch].has_files(scene.models)
        }
        self.batches = batches_of(pairs) if recipe.scene is not None else {}
        self._pairs, self._recipe, self._records, self._exports = pairs, recipe, records, exports
        self._batch_of = {index: name for name, indices in self.batches.items() for index in indices}
        self._outdated = {name for name in self.batches if self._is_outdated(name)}
        self._running: set[str] = set()
        self._losses: Counter[tuple[str, int]] = Counter()
        self._failures: dict[str, str] = {}
        self._spent_s = self._spent_matches = self._longest_start = 0.0
        self._matches = {
            name: sum(records[index].matches for index in indices) for name, indices in self.batches.items()
        }

    def note_change(self, index: int, gained: int) -> None:
        """Record that a pair has got units, or lost them, and how many matches it ``gained``."""
        if (batch := self._batch_of.get(index)) is not None:
            self._outdated.add(batch)
            self._matches[batch] += gained

    @property
    def is_complete(self) -> bool:
        """Whether no batch that has matches waits for its turn."""
        return not any(self._has_units(name) for name in self._outdated)

    def report(self) -> tuple[SceneRecord, ...]:
        """What came of each batch, in their order: where there is no scene, ``failure`` says why."""
        return tuple(
            self.made.get(name) or SceneRecord.of(name, (), failure=self._failures.get(name, NOT_RECONSTRUCTED))
            for name in self.batches
        )

    def due(self, done: Collection[int], filling: Collection[int] = ()) -> str | None:
        """A batch to reconstruct now: its matches have changed since it was, and all of its pairs are ``done``.

        For the first time it is while some of them get further matches (``filling``), for the second afterwards:
        first batches that were never reconstructed.
        """
        waiting = [name for name in self.batches if name in self._outdated and name not in self._running]
        for name in sorted(waiting, key=self.made.__contains__):
            indices, waits_for = self.batches[name], filling if name in self.made else ()
            is_ready = all(index in done and index not in waits_for for index in indices)
            if is_ready and self._has_units(name):
                return name
        return None

    def job(self, batch: str, known: Callable[[int], PairMatch]) -> SceneJob:
        """The job that reconstructs a batch; ``known`` gives what was found on a pair."""
        found = tuple(index for index in self.batches[batch] if self._records[index].sizes)
        pairs = tuple(self._batch_pair(index, known(index)) for index in found)
        self._running.add(batch)
        unit_results, export = self._unit_count(batch), self._exports.get(batch)
        return SceneJob(batch, found, pairs, self._recipe, unit_results, export)

    def on_start(self, seconds: float) -> None:
        self._longest_start = max(self._longest_start, seconds)

    def on_result(self, job: SceneJob, record: SceneRecord) -> None:
        """Record a reconstruction; it may be out of date already."""
        self._spent_s += max(0.0, record.seconds - START_S)
        self._spent_matches += sum(len(pair.matches) for pair in job.pairs)
        self._running.discard(job.batch)
        self.made[job.batch] = record
        if not self._is_outdated(job.batch):
            self._outdated.discard(job.batch)

    def on_failure(self, job: SceneJob, failure: str) -> None:
        """Record a reconstruction that was lost: this run tries it again once, the next run anyway.

        What was found before its pairs got further matches still stands.
        """
        self._running.discard(job.batch)
        self._failures[job.batch] = failure
        self._losses[job.batch, job.unit_results] += 1
        if self._losses[job.batch, job.unit_results] >= MAX_TRIES:
            self._outdated.discard(job.batch)

    def start_timeout(self, left: float) -> float:
        """Seconds after which a process that has not begun hangs; ``left`` are those of the run."""
        usual = HANG_FACTOR * max(START_S, self._longest_start) if self._longest_start else START_TIMEOUT_S
        return max(START_S, min(usual, START_SHARE * left))

    def time_limit(self, batch: str, left: float) -> float:
        """Seconds after which a reconstruction hangs: nothing is given up while time is plentiful."""
        return max(HANG_FACTOR * self._forecast(batch), min(MAX_HANG_S, HANG_SHARE * left))

    def reserve(self, at_once: int) -> float:
        """The seconds that what is left to reconstruct will most likely take, ``at_once`` at a time."""
        left = [self._forecast(name) for name in self._outdated]
        return max([*left, sum(left) / at_once], default=0.0)

    def _forecast(self, batch: str) -> float:
        rate = FORECAST_MARGIN * self._spent_s / self._spent_matches if self._spent_matches else MATCH_S
        return START_S + rate * self._matches[batch]

    def _has_units(self, batch: str) -> bool:
        return any(self._records[index].units for index in self.batches[batch])

    def _is_outdated(self, batch: str) -> bool:
        made = self.made.get(batch)
        wanted = self._unit_count(batch), self._recipe.scene_estimation
        return made is None or (made.unit_results, made.estimation) != wanted

    def _unit_count(self, batch: str) -> int:
        return sum(len(self._records[index].units) for index in self.batches[batch])

    def _batch_pair(self, index: int, found: PairMatch) -> BatchPair:
        images = zip(self._pairs[index].images, found.versions, found.sizes, found.focals, strict=True)
        image0, image1 = (BatchImage(path.name, version, size, focal) for path, version, size, focal in images)
        record = self._records[index]
        own = None if record.failure else record.pair_fundamental
        return BatchPair(image0, image1, found.matches, own, tracks_of(found.results))
