"""Batches reconstructed beside matching: which of them, when, and for how long.

A batch is taken up when all of its pairs are matched as far as time allows, and once more in the end if pairs of
it got further matches since. Pairs have the F of their own matches all the while.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.reconstruction import Reconstruction as Scene
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

LEAST_PAIRS = 2
"""Of which three images can be connected."""
START_SECONDS = 3.0
"""What a process takes to begin."""
PAIR_SECONDS = 0.2
"""What a pair adds to a reconstruction, as far as nothing is known."""
MARGIN = 1.5
"""A batch is given that many times the seconds that those before it took by their pairs."""


@dataclass(frozen=True, eq=False)
class SceneJob:
    """A batch to reconstruct; plain values, so that it can go to another process or machine.

    ``indices`` are the places of its ``pairs`` in the run. Their images go by the paths of their files, and lack
    digest and size until :func:`reconstruct` has read them.
    """

    batch: str
    indices: tuple[int, ...]
    pairs: tuple[BatchPair, ...]
    config: SceneConfig
    focal: FocalConfig | None = None
    magsac: RobustConfig | None = None


SceneAnswer = tuple[tuple[Scene, ...], dict[int, Choice]]
"""The scenes of a batch, and by a pair's place in the run which F it gets."""


class Reconstruction(Protocol):
    """A batch under way somewhere: it may crash, hang or be killed."""

    def answer(self) -> SceneAnswer | str | None:
        """What came of it, or why nothing did; ``None`` while it is under way. Does not wait."""
        ...

    def kill(self) -> None: ...


def reconstruct(job: SceneJob, read: Callable[[Path], Image | Unreadable] = read_image) -> SceneAnswer:
    """Do a job, here; it may end the process, see :mod:`mkpc_kaggle.scene.colmap`."""
    from mkpc_kaggle.scene.reconstruct import reconstruct_batch

    names = dict.fromkeys(image.name for pair in job.pairs for image in (pair.image0, pair.image1))
    known = {name: image for name in names if (image := described(Path(name), read)) is not None}
    pairs = {
        index: replace(pair, image0=known[pair.image0.name], image1=known[pair.image1.name])
        for index, pair in zip(job.indices, job.pairs, strict=True)
        if {pair.image0.name, pair.image1.name} <= known.keys()
    }
    solution = reconstruct_batch(list(pairs.values()), job.config, job.focal, job.magsac)
    return solution.reconstructions, dict(zip(pairs, solution.choices, strict=True))


def described(path: Path, read: Callable[[Path], Image | Unreadable]) -> BatchImage | None:
    """An image by the digest of its pixels; ``None`` where it cannot be read."""
    image = read(path)
    if not isinstance(image, Image):
        return None
    return BatchImage(str(path), hashlib.sha256(image.pixels.tobytes()).hexdigest(), image.size)


def pairs_to_add(pairs: Sequence[Pair], config: SceneConfig | None) -> list[Pair]:
    """Pairs of images of a batch that no row names, to be matched for its scene; see ``SceneConfig``."""
    added: list[Pair] = []
    for batch, places in batches_of(pairs).items() if config is not None else ():
        asked = [pairs[place] for place in places]
        files = list(dict.fromkeys(file for pair in asked for file in (pair.file0, pair.file1)))
        assert config is not None
        number = {file: place for place, file in enumerate(files)}
        ends = [(number[pair.file0], number[pair.file1]) for pair in asked]
        found = [(files[i], files[j]) for i, j in extra_pairs(len(files), ends, config.pairs_per_image)]
        added += [Pair(f"{batch};{Path(a).stem}-{Path(b).stem}", batch, a, b) for a, b in found]
    return added


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """By batch, the places of the pairs that may be reconstructed: F is wanted, and no camera is known."""
    batches: dict[str, list[int]] = {}
    for place, pair in enumerate(pairs):
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(place)
    return {name: members for name, members in batches.items() if len(members) >= LEAST_PAIRS}


@dataclass(frozen=True, eq=False)
class SceneResult:
    """What came of a batch: its scenes, and by pair which F it gets; ``failure`` is empty, or says why nothing."""

    batch: str
    scenes: tuple[Scene, ...]
    choices: Mapping[int, Choice]
    seconds: float
    failure: str = ""


@dataclass(frozen=True, eq=False)
class Running:
    """A reconstruction that began at ``started`` and is taken to hang ``timeout`` seconds later."""

    reconstruction: Reconstruction
    started: float
    timeout: float


class SceneQueue:
    """Which batches to reconstruct, and when; ``clock`` and ``limit`` are the run's."""

    def __init__(
        self,
        pairs: Sequence[Pair],
        config: SceneConfig | None,
        clock: Callable[[], float],
        timeouts: Timeouts,
        limit: float,
    ) -> None:
        self.config = config
        self.batches = batches_of(pairs) if config is not None else {}
        self.running: dict[str, Running] = {}
        self._batch_of = {index: name for name, indices in self.batches.items() for index in indices}
        self._changed = set(self.batches)
        self._taken_up: set[str] = set()
        self._clock, self._timeouts, self._limit = clock, timeouts, limit
        self._spent_seconds = self._spent_pairs = 0.0

    def note_solved(self, indices: Iterable[int]) -> None:
        """Pairs that an earlier run had reconstructed: their batches need not be again."""
        solved = {self._batch_of[index] for index in indices if index in self._batch_of}
        self._changed -= solved
        self._taken_up |= solved

    def note_change(self, index: int) -> None:
        """A pair got further matches."""
        if index in self._batch_of:
            self._changed.add(self._batch_of[index])

    def needs(self, index: int) -> bool:
        """Whether a reconstruction to come wants the pair's matches."""
        return self._batch_of.get(index) in self._changed

    def due(self, deepened: set[int], *, again: bool) -> str | None:
        """A batch whose pairs are all matched, as far as time allows; one that was taken up before only ``again``,
        since its pairs may go on changing.
        """
        for name in self.batches:
            if name not in self._changed or name in self.running or (name in self._taken_up and not again):
                continue
            if deepened.issuperset(self.batches[name]):
                return name
        return None

    def start(self, batch: str, reconstruction: Reconstruction) -> None:
        """Take note of what has begun."""
        self._changed.discard(batch)
        self._taken_up.add(batch)
        timeout = self._timeouts.of_scene(self._forecast(batch), self._limit)
        self.running[batch] = Running(reconstruction, self._clock(), timeout)

    def finished(self) -> list[SceneResult]:
        """What has ended since, by itself or because it hung."""
        ended = [self._result(batch, running) for batch, running in self.running.items()]
        results = [result for result in ended if result is not None]
        for result in results:
            self.running.pop(result.batch).reconstruction.kill()
        return results

    def close(self) -> None:
        for running in self.running.values():
            running.reconstruction.kill()

    def reserve(self, at_once: int) -> float:
        """The seconds that what is left to do will most likely take, ``at_once`` at a time."""
        left = [self._forecast(name) for name in self._changed | set(self.running)]
        return max([*left, sum(left) / at_once], default=0.0)

    def _forecast(self, batch: str) -> float:
        rate = MARGIN * self._spent_seconds / self._spent_pairs if self._spent_pairs else PAIR_SECONDS
        return START_SECONDS + rate * len(self.batches[batch])

    def _result(self, batch: str, running: Running) -> SceneResult | None:
        answer, seconds = running.reconstruction.answer(), self._clock() - running.started
        if answer is None and seconds < running.timeout:
            return None
        if answer is None:
            return SceneResult(batch, (), {}, seconds, f"it hung: no answer for {running.timeout:.0f} s")
        if isinstance(answer, str):
            return SceneResult(batch, (), {}, seconds, answer)
        self._spent_seconds += max(0.0, seconds - START_SECONDS)
        self._spent_pairs += len(self.batches[batch])
        return SceneResult(batch, *answer, seconds)
