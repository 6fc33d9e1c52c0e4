"""Versions of the results: in the request's own files, and as the table of pairs that reports read."""

import json
import threading
from dataclasses import asdict, dataclass, field
from math import inf

import numpy as np

from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.state import FALLBACK, SOURCES, State
from mkpc_kaggle.engine.store import Store

# Between versions: a run that is killed loses at most this from its submission
INTERVAL_S = 30.0
TIME_SHARE = 0.05  # maximum share of the time for writing versions, if a disk is slow


@dataclass(eq=False)
class Publication:
    """The versions of a request's results. The loop publishes; the watchdog may save the last
    version from its own thread.
    """

    state: State
    store: Store
    budget: Budget
    has_ended: bool = False
    published: float = -inf
    lock: threading.Lock = field(default_factory=threading.Lock)

    def is_due(self, now: float) -> bool:
        interval = max(INTERVAL_S, self.budget.writing / TIME_SHARE)
        return now - self.published > interval

    def publish(self, *, is_last: bool = False) -> None:
        """Write the results, and the rows of the pairs that have changed since the last version. After the last
        one, the watchdog writes no other.
        """
        start = self.budget.clock()
        self.save()
        state = self.state
        about = state.request.about
        about.seconds = start - self.budget.started
        about.failures = list(state.scene_failures.values())
        # The key of each batch's scene, and the reason if it has none
        made = state.scenes
        keys = [made[batch].key if batch in made else "" for batch in state.batches]
        scenes = list(zip(state.batches, keys, state.scene_reasons, strict=True))
        facts = json.dumps({**asdict(about), "scenes": scenes})
        rows = self._rows()
        self.store.put({"pair": rows, "run": [(0, len(state.pair_of_row), facts)]})
        about.unsaved = self.store.trouble
        # The measured time decides when the last version is written.
        self.published = self.budget.clock()
        self.budget.writes.append(self.published - start)
        self.has_ended = is_last

    def save(self) -> str:
        """Write the results unless the run has ended. Return why that failed, or an empty text."""
        about = self.state.request.about
        # The loop and the watchdog would remove each other's temporary file.
        with self.lock:
            if not self.has_ended:
                try:
                    self.state.request.publish(self.state)
                    about.unwritten = ""
                # A full disk must not end the run; other errors are bugs and do.
                except OSError as error:
                    about.unwritten = f"the results cannot be written: {error}"
        return about.unwritten

    def _rows(self) -> list[tuple[object, ...]]:
        """Return the rows of the pairs that have changed."""
        state = self.state
        sources, fundamentals = state.written
        scenes = state.scenes
        pending = state.lacks_estimate
        changed = np.flatnonzero(state.dirty[state.pair_of_row]).tolist()
        state.dirty[:] = False
        rows: list[tuple[object, ...]] = []
        for number in changed:
            index = int(state.pair_of_row[number])
            batch = state.pairs[index].group
            choices = scenes[batch].choices if batch in scenes else {}
            choice = choices.get(state.contents(index))
            # An error counts if it left the pair without an F.
            is_lost = sources[number] == FALLBACK and not pending[index]
            reasons = state.reasons.get(index, {}) if is_lost else {}
            row = (
                number,
                state.request.pairs[number].id,
                batch,
                *state.names[index],
                json.dumps(self._units(index)),
                state.estimate[index].decode(),
                np.asarray(fundamentals[number], "<f8").tobytes(),
                SOURCES[sources[number]],
                "" if choice is None else choice.reason,
                next(iter(reasons.values()), ""),
            )
            rows.append(row)
        return rows

    def _units(self, index: int) -> list[tuple[str, str, bool, str]]:
        """Return name, key, need and failure of each unit of a pair that has points, or a failure."""
        state = self.state
        reasons = state.reasons.get(index, {})
        facts = (facts[index].tolist() for facts in (state.points, state.done, state.needed))
        units = []
        for unit, key, is_done, is_needed in zip(state.units, *facts, strict=True):
            name = unit.name
            if is_done:
                units.append((name, key.decode(), is_needed, ""))
            elif name in reasons:
                units.append((name, "", is_needed, reasons[name]))
        return units
