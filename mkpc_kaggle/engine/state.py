"""The state of all pairs of a request: arrays from the journal's views, kept up to date."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.jobs import Outcome, PairPoints, PointSource, WantedPair
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import matrix_of
from mkpc_kaggle.engine.request import Request
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


class State:
    """Arrays for the N pairs of a request and the U units of its recipe, in their order.

    ``had`` (N, U): current points exist. ``matches`` (N,): their number. ``is_estimated`` (N,): the estimate is
    current. ``inliers`` (N,), the F ``own`` (N, 3, 3) and ``has_own`` (N,) are of the standing estimate.
    ``unreadable`` (N,): an image cannot be read. The first ``rows`` pairs have a row. ``changed``: pairs whose
    points or estimate changed since :class:`Scenes` last looked. ``digests`` has each image's digest by name.
    """

    def __init__(
        self, journal: Journal, request: Request, pairs: Sequence[WantedPair], digests: Mapping[str, str]
    ) -> None:
        self.journal, self.request, self.pairs, self.digests = journal, request, pairs, dict(digests)
        self.rows, count = len(request.pairs), len(pairs)
        self.units = {unit.name: unit for unit in request.recipe.units}
        self.had = np.zeros((count, len(self.units)), bool)
        self.matches, self.inliers = np.zeros(count, int), np.zeros(count, int)
        self.is_estimated, self.has_own, self.unreadable = (np.zeros(count, bool) for _ in range(3))
        self.own = np.tile(FALLBACK_FUNDAMENTAL, (count, 1, 1))
        self.by_scene: dict[int, NDArray[np.float64]] = {}
        self.changed: set[int] = set()
        self._read(None if count else ())
        self.read_choices()

    @property
    def fundamentals(self) -> NDArray[np.float64]:
        """The F to write (rows, 3, 3): the scene's, else the pair's, else the fallback."""
        written = self.own[: self.rows].copy()
        for position, F in self.by_scene.items():
            if position < self.rows:
                written[position] = F
        return written

    def save_outcomes(self, outcomes: Sequence[Outcome]) -> None:
        """Save a job's results on its pairs."""
        settings = dict(zip(self.units, self.request.settings.units, strict=True))
        self.journal.save_outcomes(outcomes, settings)
        self.digests |= {image.name: image.digest for outcome in outcomes for image in outcome.images}
        self.refresh(outcome.index for outcome in outcomes)

    def refresh(self, positions: Iterable[int]) -> None:
        """Read these pairs again, and all rows that repeat them."""
        changed = {twin for position in positions for twin in self.journal.twins(position)}
        self._read(sorted(changed))
        self.changed |= changed

    def read_choices(self) -> None:
        """Read which pairs take F from their scene."""
        self.by_scene = {n: choice.F for n, choice in self.journal.choices().items() if choice.F is not None}

    def points_of(self, positions: Iterable[int]) -> tuple[tuple[PairPoints, ...], PointSource]:
        """Return references to the current points of pairs, and the source from which workers read points."""
        pairs = tuple(map(self._points_of, positions))
        revisions = [revision for pair in pairs for revision in pair.revisions]
        return pairs, self.journal.points(revisions) if self.journal.is_in_memory else self.journal.path.parent

    def _points_of(self, position: int) -> PairPoints:
        image0, image1 = self.journal.images(position)
        points = tuple((self.units[name], row) for name, row in self.journal.inputs(position).items())
        own = self.own[position] if self.has_own[position] else None
        return PairPoints(position, (image0, image1), points, self.pairs[position].pair.intrinsics, own)

    def _read(self, positions: Sequence[int] | None) -> None:
        for position, units, matches, F, inliers, failure, is_current in self.journal.states(positions):
            self.had[position] = False
            self.had[position, [*map(int, (units or "").split())]] = True
            self.matches[position], self.is_estimated[position] = matches or 0, bool(is_current)
            if F is not None:
                self.own[position], self.has_own[position] = matrix_of(F), not failure
                self.inliers[position] = inliers or 0
