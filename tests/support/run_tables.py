"""Tables of a run whose pairs a test describes, made as those of a real run."""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from mkpc_kaggle.engine.frames import PairTables, pair_tables
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL

UNIT = "1:sift@640"


class Described:
    """A pair of two images with one unit. It was reached unless ``failure`` is ``None``.

    ``error`` is why the unit failed; other values are of its points, and of the pair's estimate.
    """

    def __init__(
        self,
        name: str = "a",
        images: tuple[str, str] = ("0.png", "1.png"),
        group: str = "batch",
        *,
        failure: str | None = "",
        error: str = "",
        source: str = "fallback",
        choice: str = "",
        matches: int = 0,
        inliers: int = 0,
        seconds: float = 0.0,
        **statistics: float,
    ) -> None:
        self.about = (name, group, *images)
        self.failure = failure
        self.reasons = {UNIT: error} if error else {}
        self.source, self.choice = source, choice
        self.matches, self.inliers, self.seconds = matches, inliers, seconds
        self.statistics = statistics

    def rows(self, number: int) -> dict[str, list[tuple[Any, ...]]]:
        """The rows of the store, with a key for each pair."""
        key = f"points {number}" if self.matches else ""
        F = FALLBACK_FUNDAMENTAL
        facts = {"F": F.ravel().tolist(), "failure": self.failure, "inliers": {key: self.inliers}}
        estimate = "" if self.failure is None else f"estimate {number}"
        points = (key, self.matches, 0, 0.0, 0.0, self.seconds, 0.0, None, None, "", "", b"")
        pair = (json.dumps([[key, True]]), estimate, F.tobytes(), self.source, self.choice)
        return {
            "points": [points] if key else [],
            "result": [(estimate, json.dumps(facts | self.statistics))] if estimate else [],
            "pair": [(number, *self.about, *pair, json.dumps(self.reasons))],
        }


def tables_of(*described: Described) -> PairTables:
    """Return the tables of these pairs."""
    store = Store.in_memory(Path())
    with closing(store.db):
        for number, each in enumerate(described):
            store.put(each.rows(number))
        about = {"units": [(UNIT, 1)], "rows": len(described)}
        store.put({"run": [(0, json.dumps(about))]})
        return pair_tables(store.db)
