"""Batches reconstructed beside matching: each in a process of its own, which may crash, hang or be killed.

A batch is taken up when all of its pairs are matched as far as time allows, and once more in the end if pairs of
it got further matches since. Pairs have the F of their own matches all the while.
"""

import multiprocessing
import signal
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.exits import how_it_ended
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3, Model
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.model import Scene

LEAST_PAIRS = 2
"""Of which three images can be connected."""
START_SECONDS = 3.0
"""What a process takes to begin, as far as nothing is known."""
PAIR_SECONDS = 0.2
"""What a pair adds to a reconstruction, as far as nothing is known."""


@dataclass(frozen=True, eq=False)
class ScenePair:
    """A pair as a reconstruction is given it: its place in the run, its images' files, its matches and own F."""

    index: int
    images: tuple[Path, Path]
    matches: Matches
    own: Matrix3 | None


@dataclass(frozen=True, eq=False)
class SceneResult:
    """What came of a batch: its scenes, and by pair which F it gets; ``failure`` is empty, or says why nothing."""

    batch: str
    scenes: tuple[Scene, ...] = ()
    choices: Mapping[int, Choice] | None = None
    seconds: float = 0.0
    failure: str = ""


class Reconstruction:
    """One batch under way in a process of its own."""

    def __init__(self, batch: str, pairs: Sequence[ScenePair], config: SceneConfig) -> None:
        self.batch = batch
        self._started = time.monotonic()
        context = multiprocessing.get_context("spawn")
        self._answers, its_answers = context.Pipe(duplex=False)
        self._process: SpawnProcess = context.Process(
            target=reconstruct_batch, args=(tuple(pairs), config, its_answers), name="mkpc scene", daemon=True
        )
        self._process.start()
        its_answers.close()

    def result(self) -> SceneResult | None:
        """What came of it; ``None`` while it is under way."""
        seconds = time.monotonic() - self._started
        if not self._answers.poll() and self._process.is_alive():
            return None
        try:
            scenes, choices = self._answers.recv()
        except (EOFError, OSError):
            self._process.join(timeout=1.0)  # its pipe closes before it has ended
            self.kill()
            return SceneResult(
                self.batch, seconds=seconds, failure=f"its process ended: {how_it_ended(self._process)}"
            )
        self.kill()
        return SceneResult(self.batch, scenes, choices, seconds)

    def kill(self) -> None:
        self._process.kill()
        self._process.join(timeout=1.0)


def reconstruct_batch(pairs: Sequence[ScenePair], config: SceneConfig, answers: Connection) -> None:
    """The life of a process: sends the scenes, and the choice for each pair by its place in the run."""
    # Ctrl-C reaches every process of a terminal; the parent answers to it, and kills this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from mkpc_kaggle.scene.read import batch_of
    from mkpc_kaggle.scene.solve import solve

    readable, batch = batch_of([(pair.images, pair.matches, pair.own) for pair in pairs])
    solution = solve(batch, config)
    indices = [pairs[place].index for place in readable]
    answers.send((solution.scenes, dict(zip(indices, solution.choices, strict=True))))


class SceneQueue:
    """Which batches to reconstruct, and when: one at a time, beside matching."""

    def __init__(self, pairs: Sequence[Pair], config: SceneConfig | None) -> None:
        self.config = config
        batches: dict[str, list[int]] = {}
        for index, pair in enumerate(pairs) if config is not None else ():
            if pair.model is Model.F and pair.intrinsics is None:
                batches.setdefault(pair.group, []).append(index)
        self.batches = {name: indices for name, indices in batches.items() if len(indices) >= LEAST_PAIRS}
        self._batch_of = {index: name for name, indices in self.batches.items() for index in indices}
        self._changed = set(self.batches)
        self._spent_seconds = self._spent_pairs = 0.0
        self.running: Reconstruction | None = None

    def note_solved(self, indices: Iterable[int]) -> None:
        """Pairs that an earlier run had reconstructed: their batches need not be again."""
        self._changed -= {self._batch_of[index] for index in indices if index in self._batch_of}

    def note_change(self, index: int) -> None:
        """A pair got further matches."""
        if index in self._batch_of:
            self._changed.add(self._batch_of[index])

    def needs(self, index: int) -> bool:
        """Whether a reconstruction to come wants the pair's matches."""
        return self._batch_of.get(index) in self._changed

    def due(self, deepened: set[int]) -> str | None:
        """A batch whose pairs are all matched, as far as time allows; ``None`` while one is under way."""
        if self.running is not None:
            return None
        for name in self.batches:
            if name in self._changed and deepened.issuperset(self.batches[name]):
                return name
        return None

    def start(self, batch: str, pairs: Sequence[ScenePair]) -> None:
        assert self.config is not None
        self._changed.discard(batch)
        self.running = Reconstruction(batch, pairs, self.config)

    def finished(self) -> SceneResult | None:
        """The reconstruction that has ended since, if one has."""
        result = self.running.result() if self.running is not None else None
        if result is not None:
            self.running = None
            self._spent_seconds += result.seconds
            self._spent_pairs += len(self.batches[result.batch])
        return result

    def close(self) -> None:
        if self.running is not None:
            self.running.kill()

    @property
    def reserve(self) -> float:
        """Seconds that the largest batch still to do will most likely take: what comes last cannot run beside."""
        left = [len(self.batches[name]) for name in self._changed]
        rate = self._spent_seconds / self._spent_pairs if self._spent_pairs else PAIR_SECONDS
        return START_SECONDS + rate * max(left) if left else 0.0
