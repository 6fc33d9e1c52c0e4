"""The state of all pairs of a run in arrays: the answers of the journal's views, kept up to date."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import matrix_of
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


class State:
    """Arrays for N pairs and U units, by their positions in the run and in the recipe.

    ``had`` (N, U): the current points. ``matches`` (N,): their number. ``is_estimated`` (N,): whether the estimate
    is current. ``inliers`` (N,), ``own`` (N, 3, 3), ``has_own`` (N,): of the standing estimate. ``unreadable``
    (N,): an image cannot be read. The first ``rows`` pairs have a row.
    """

    def __init__(self, journal: Journal, pairs: int, rows: int, units: int) -> None:
        self.rows, self._journal = rows, journal
        self.had = np.zeros((pairs, units), bool)
        self.matches, self.inliers = np.zeros(pairs, int), np.zeros(pairs, int)
        self.is_estimated, self.has_own, self.unreadable = (np.zeros(pairs, bool) for _ in range(3))
        self.own = np.tile(FALLBACK_FUNDAMENTAL, (pairs, 1, 1))
        self.by_scene: dict[int, NDArray[np.float64]] = {}
        self._twins = journal.twins()
        self._read(None if pairs else ())
        self.read_choices()

    @property
    def has_row(self) -> NDArray[np.bool_]:
        """(N,) mask."""
        return np.arange(len(self.had)) < self.rows

    @property
    def fundamentals(self) -> NDArray[np.float64]:
        """(rows, 3, 3): the F to write: the scene's, else the pair's, else the fallback."""
        written = self.own[: self.rows].copy()
        for position, F in self.by_scene.items():
            if position < self.rows:
                written[position] = F
        return written

    def refresh(self, positions: Iterable[int]) -> set[int]:
        """Read these pairs again, and all rows of the same images. Return their positions."""
        changed = {twin for position in positions for twin in self._twins.get(position, (position,))}
        index = sorted(changed)
        self.had[index], self.matches[index], self.is_estimated[index] = False, 0, False
        self._read(index)
        return changed

    def read_choices(self) -> None:
        """Read which pairs have the F of their scene."""
        self.by_scene = {n: choice.F for n, choice in self._journal.choices().items() if choice.F is not None}

    def _read(self, positions: Sequence[int] | None) -> None:
        for position, unit, matches in self._journal.had(positions):
            self.had[position, unit] = True
            self.matches[position] += matches
        for position, F, inliers, failure, is_current in self._journal.estimated(positions):
            self.own[position], self.has_own[position] = matrix_of(F), not failure
            self.inliers[position] = sum(map(int, inliers.split()))
            self.is_estimated[position] = is_current
