"""Tables of a run whose pairs a test describes, made as those of a real run."""

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

from simulator import facts_of, memory_store

from mkpc_kaggle.engine.frames import ELEMENTS, Results, results_of
from mkpc_kaggle.engine.request import About
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.scene.records import SceneRecord

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
        self.error = error
        self.source, self.choice = source, choice
        self.matches, self.inliers, self.seconds = matches, inliers, seconds
        self.statistics = statistics

    def rows(self, number: int) -> dict[str, list[tuple[Any, ...]]]:
        """The rows of the store, with a key for each pair."""
        key = f"points {number}" if self.matches else ""
        F = FALLBACK_FUNDAMENTAL
        facts = facts_of({key: self.inliers}) | {"failure": self.failure}
        estimate = "" if self.failure is None else f"estimate {number}"
        points = (key, self.matches, 0, self.seconds, None, None, "", "", b"")
        has_run = bool(key or self.error)
        units = json.dumps([[UNIT, key, True, self.error]] if has_run else [])
        error = self.error if self.source == "fallback" else ""
        pair = (units, estimate, F.tobytes(), self.source, self.choice, error)
        return {
            "points": [points] if key else [],
            "result": [(estimate, json.dumps(facts | self.statistics))] if estimate else [],
            "pair": [(number, *self.about, *pair)],
        }


def tables_of(
    *described: Described,
    scenes: Sequence[SceneRecord] = (),
    files: Mapping[str, Sequence[str]] = MappingProxyType({}),
    digests: Mapping[str, str] = MappingProxyType({}),
) -> Results:
    """Return the tables of these pairs and scenes; ``digests`` are of images by name."""
    store = memory_store()
    with closing(store.db):
        for number, each in enumerate(described):
            store.put(each.rows(number))
        images = [(name, 0, 0, content, 80, 60, 0.0) for name, content in digests.items()]
        store.put(
            {
                "image": images,
                "result": [(each.key, each.to_json()) for each in scenes if each.key],
            }
        )
        about = asdict(About({"name": "x"}, files=dict(files)))
        about["scenes"] = [(each.batch, each.key, each.failure) for each in scenes]
        store.put({"run": [(0, len(described), json.dumps(about))]})
        return results_of(store)


def matrices_of(pairs: Any) -> Any:
    """The written matrices (N, 3, 3) of a table of pairs."""
    return pairs[ELEMENTS].to_numpy(float).reshape(-1, 3, 3)
