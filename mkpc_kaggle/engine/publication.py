"""Publication: versions of the results, in the request's own files and as the table of pairs."""

import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mkpc_kaggle.engine.jobs import Cause, Failure
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.plan.state import SOURCES, State
from mkpc_kaggle.engine.run import EventLog
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.tables import PublishedPair, PublishedRun
from mkpc_kaggle.geometry.robust import ModelKind

INTERVAL_S = 30.0  # between versions: a run that is killed loses at most this from its submission
TIME_SHARE = 0.05  # maximum share of the time for writing versions, if a disk is slow


class Publication:
    """The versions of a request's results. The loop publishes; the watchdog may save the last
    version from its own thread.
    """

    def __init__(
        self,
        state: State,
        store: Store,
        budget: Budget,
        log: EventLog,
        trials: Sequence[str] = (),
    ) -> None:
        self._state = state
        self._store = store
        self._budget = budget
        self._log = log
        self._trials = trials  # keys of the results of earlier requests that were trials
        self._lock = threading.Lock()
        self._has_ended = False
        self._published = budget.clock()
        self._rows: dict[int, PublishedPair] = {}  # by number
        self._sources = np.full(len(state.pair_of_row), -1)  # of the rows, as in the last version
        # The numbers of each pair's rows. An extra pair has one after the request's rows.
        extra = np.arange(len(state.pairs) - state.rows) + len(state.pair_of_row)
        self._numbers: list[list[int]] = [[] for _ in range(state.rows)]
        for number, index in enumerate(state.pair_of_row):
            self._numbers[index].append(number)
        self._numbers += [[number] for number in extra.tolist()]
        self.unwritten = ""  # why the latest version could not be written

    def is_due(self, now: float) -> bool:
        interval = max(INTERVAL_S, self._budget.writing / TIME_SHARE)
        return now - self._published > interval

    def publish(self) -> None:
        """Write the results, and the table of pairs that names them.

        If the results cannot be written, a fault states why, and the next run writes them first.
        """
        state = self._state
        # Without pairs, as in a folder of one image, no file of the request changes.
        if not state.rows:
            return
        start = self._budget.clock()
        if trouble := self.save():
            self._log.fault(trouble)
        # Also if the results were not written: a prune removes what the table does not name.
        # A trial's pairs are not the run's, whose table stays until its own pairs are known.
        changed = self._update_rows()
        if not state.request.is_trial:
            self._store.put([self._run(), *changed])
        # The measured time decides when the last version is written.
        self._published = self._budget.clock()
        self._budget.note_write(self._published - start)

    def save(self) -> str:
        """Write the results unless the run has ended. Return why that failed, or an empty text."""
        # The loop and the watchdog would write the same temporary file.
        with self._lock:
            if not self._has_ended:
                try:
                    self._state.request.publish(self._state)
                    self.unwritten = ""
                # A full disk must not end the run; other errors are bugs and do.
                except OSError as error:
                    self.unwritten = f"the results cannot be written: {error}"
        return self.unwritten

    def end(self) -> None:
        """Publish the last version. After it, the watchdog writes no other."""
        self.publish()
        self._has_ended = True

    def version(self) -> Published:
        """Return the present version of the results."""
        self._update_rows()
        return Published(self._run(), [self._rows[index] for index in range(len(self._rows))])

    def _run(self) -> PublishedRun:
        state = self._state
        return PublishedRun(
            about=state.request.about,
            units=[(unit.name, unit.stage) for unit in state.units],
            rows=len(state.pair_of_row),
            pairs=len(state.pair_of_row) + len(state.pairs) - state.rows,
            scenes={batch: scene.key for batch, scene in state.scenes.in_use.items()},
            rivals=state.scenes.rivals,
            trials=self._trials,
        )

    def _update_rows(self) -> list[PublishedPair]:
        """Build the rows of the pairs that have changed since the last version. Return them."""
        state = self._state
        sources = state.sources
        fundamentals = state.fundamentals
        # A pair may get another F although it has no new result: its scene is not made after all.
        moved = state.pair_of_row[sources != self._sources]
        self._sources = sources
        changed = []
        for index in sorted({*state.take_changed(), *moved.tolist()}):
            row = _row(state, index)
            for number in self._numbers[index]:
                row = replace(row, number=number)
                # An extra pair has no row in the submission, and so no written F.
                if index < state.rows:
                    row = replace(
                        row,
                        id=state.request.pairs[number].id,
                        source=SOURCES[sources[number]],
                        F=fundamentals[number],
                    )
                changed.append(row)
                self._rows[number] = row
        return changed


def _row(state: State, index: int) -> PublishedPair:
    pair = state.pairs[index]
    image0, image1 = state.names[index]
    points = state.points[index].tolist()
    given_up = state.tries.given_up
    # The reason of each unit that was given up on the pair, for any cause
    failures = {}
    for unit in state.units:
        failure = given_up.get(("unit", index, unit.name))
        if failure is not None:
            failures[unit.name] = _reason(failure)
    reason = ""
    if unread := given_up.get(("pair", index)):
        reason = unread.message
    elif failures and not any(points):
        reason = next(iter(failures.values()))
    # Without an estimate, and not because of the time
    lost = state.lost_estimates.get(index)
    unestimated = _reason(lost) if lost is not None and not state.estimates[index] else ""
    contents = state.contents(index)
    scene = state.scenes.in_use.get(pair.group)
    choice = None if scene is None else scene.choices.get(contents)
    return PublishedPair(
        index,
        id=pair.id,
        batch=pair.group,
        image0=image0,
        image1=image1,
        turns0=pair.turns[0],
        turns1=pair.turns[1],
        contents=contents,
        points=points,
        estimate=state.estimates[index],
        model=ModelKind.F if pair.intrinsics is None else ModelKind.E,
        source="",
        choice="" if choice is None else choice.reason,
        failures=failures,
        failure=reason,
        unestimated=unestimated,
    )


def _reason(failure: Failure) -> str:
    # The unit's name stands next to the message of its matcher.
    return failure.message if failure.cause is Cause.UNIT_RAISED else str(failure)
