"""Chunks of pairs in the order of their turn: what is waiting, what is under way, what has to be tried again."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace

from mkpc_kaggle.engine.jobs import Chunk, Phase
from mkpc_kaggle.recipe import Unit


class ChunkQueue:
    """The chunks of the present phase. A chunk's turn comes when none of its pairs is in a job under way."""

    def __init__(self) -> None:
        self.phase = Phase.SWEEP
        self.in_flight: set[int] = set()
        self.jobs = 0
        self._waiting: deque[Chunk] = deque()
        self._retries: deque[Chunk] = deque()
        self._pairs = self._pairs_waiting = 0

    def open(self, phase: Phase, chunks: Iterable[Chunk]) -> None:
        """Begin a phase."""
        self.phase = phase
        self._waiting.extend(chunks)
        self._pairs = self._pairs_waiting = sum(len(chunk.indices) for chunk in self._waiting)

    def pop_retry(self) -> Chunk | None:
        """The first chunk to try again whose turn has come; these go before all others."""
        for chunk in self._retries:
            if self.in_flight.isdisjoint(chunk.indices):
                self._retries.remove(chunk)
                return chunk
        return None

    def peek(self) -> Chunk | None:
        """The next chunk of the phase, if its turn has come."""
        if self._waiting and self.in_flight.isdisjoint(self._waiting[0].indices):
            return self._waiting[0]
        return None

    def pop(self) -> Chunk:
        """Take out the chunk that :meth:`peek` shows."""
        chunk = self._waiting.popleft()
        self._pairs_waiting -= len(chunk.indices)
        return chunk

    def put_first(self, chunk: Chunk) -> None:
        """Give a chunk back, or what is left of it: it is the next one."""
        self._retries.appendleft(chunk)

    def retry(self, chunks: Iterable[Chunk]) -> None:
        """Try these again, after what waits for that already."""
        self._retries.extend(chunks)

    def limit_units(self, units: tuple[Unit, ...]) -> None:
        """All waiting chunks get these units, and are in no round."""
        self._waiting = deque(replace(chunk, units=units, round=0) for chunk in self._waiting)

    def begin(self, indices: Iterable[int]) -> None:
        """A job on these pairs is under way."""
        self.in_flight.update(indices)
        self.jobs += 1

    def end(self, indices: Iterable[int]) -> None:
        self.in_flight.difference_update(indices)
        self.jobs -= 1

    def are_back(self, indices: Sequence[int]) -> bool:
        """Whether none of these pairs is under way or has to be tried again."""
        retried = {index for chunk in self._retries for index in chunk.indices}
        return self.in_flight.isdisjoint(indices) and retried.isdisjoint(indices)

    @property
    def is_empty(self) -> bool:
        """Whether no chunk waits; jobs may be under way, and chunks have to be tried again."""
        return not self._waiting

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way and nothing has to be tried again."""
        return not self.in_flight and not self._retries

    @property
    def progress(self) -> tuple[Phase, int, int]:
        """The present phase, how many of its pairs are done, and how many it has."""
        ahead = self._pairs_waiting + len(self.in_flight) + sum(len(chunk.indices) for chunk in self._retries)
        return self.phase, max(0, self._pairs - ahead), self._pairs
