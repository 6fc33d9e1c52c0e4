"""Batches reconstructed in parallel with matching: which of them, when, and how long they take."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Failure, SceneJob
from mkpc_kaggle.engine.losses import Losses
from mkpc_kaggle.engine.records import SceneRecord
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs

MIN_PAIRS = 2  # they can connect three images
START_S = 3.0  # that a process takes to begin
MATCH_S = 5e-4  # that a match adds to a reconstruction, before any was measured
FORECAST_MARGIN = 1.5  # of a forecast from the matches of earlier scenes
NOT_RECONSTRUCTED = "not reconstructed in time"

Mask = NDArray[np.bool_]


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the indices of the pairs of each batch that may be reconstructed: F is wanted, no camera is known."""
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def extra_pairs_of(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Return pairs of a batch's images that no row names, for its scene alone; the most useful first.

    Each batch gets up to ``pairs_per_image``, the batch with the fewest pairs per image first.
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
    """The batches of a run, by name with the positions of their pairs, and which scenes are out of date.

    ``made`` are the standing reconstructions. ``losses`` has why a reconstruction failed.
    """

    def __init__(self, batches: Mapping[str, list[int]], made: dict[str, SceneRecord], current: set[str]) -> None:
        self.batches, self.made = batches, made
        self.stale = set(batches) - current
        self.running: set[str] = set()
        self.losses: Losses[str] = Losses()
        self._batch_of = {index: name for name, indices in batches.items() for index in indices}
        self._rate = 0.0, 0  # seconds and matches of the scenes of this run

    def note_change(self, positions: Iterable[int]) -> None:
        """Record that pairs have other points or another estimate."""
        changed = {self._batch_of[index] for index in positions if index in self._batch_of}
        self.stale |= changed
        for name in changed:
            self.losses.skipped.pop(name, None)

    def waiting(self, matches: NDArray[np.int_]) -> list[str]:
        """Return the batches to reconstruct, never reconstructed batches first. ``matches`` (N,) of each pair."""
        names = [
            name
            for name in self.batches
            if name in self.stale - self.running
            and name not in self.losses.skipped
            and matches[self.batches[name]].any()
        ]
        return sorted(names, key=self.made.__contains__)

    def due(self, matches: NDArray[np.int_], settled: Mask, filled: Mask) -> str | None:
        """Return a batch whose pairs are all ``settled``, and all ``filled`` if it has a scene already."""
        for name in self.waiting(matches):
            if (filled if name in self.made else settled)[self.batches[name]].all():
                return name
        return None

    def on_result(self, job: SceneJob, record: SceneRecord, *, is_current: bool) -> None:
        """Record a reconstruction, which may be out of date already."""
        seconds, matches = self._rate
        self._rate = seconds + max(0.0, record.seconds - START_S), matches + job.matches
        self.running.discard(job.batch)
        self.made[job.batch] = record
        if is_current:
            self.stale.discard(job.batch)

    def on_failure(self, job: SceneJob, failure: Failure) -> None:
        """Record a lost reconstruction: this run tries it again once, the next run again."""
        self.running.discard(job.batch)
        self.losses.add([job.batch], failure)

    def skip_all(self, failure: Failure) -> None:
        """No worker reconstructs any further batch."""
        self.losses.skipped |= dict.fromkeys(self.stale, failure)

    def reserve(self, matches: NDArray[np.int_]) -> float:
        """Return the seconds that the pending reconstructions will probably take."""
        pending = [name for name in self.stale if name not in self.losses.skipped]
        return sum(self.forecast(float(matches[self.batches[name]].sum())) for name in pending)

    def forecast(self, matches: float) -> float:
        """Return the seconds that a reconstruction will probably take."""
        seconds, done = self._rate
        return START_S + matches * (FORECAST_MARGIN * seconds / done if done else MATCH_S)

    def report(self) -> tuple[SceneRecord, ...]:
        """Return the scene of each batch, in order; ``failure`` is the reason for a missing scene."""
        missing = {name: str(self.losses.skipped.get(name, NOT_RECONSTRUCTED)) for name in self.batches}
        return tuple(self.made.get(name) or SceneRecord(name, failure=missing[name]) for name in self.batches)
