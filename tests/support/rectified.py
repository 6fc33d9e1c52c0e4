"""A matcher whose answers are known, and runs of the engine with it.

It sees every pair as rectified: a point of image 1 is the point of image 0, moved along its row.
So F is [e_x]_x, and each of its matches is an inlier.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.session import Session, run_pairs, submit
from mkpc_kaggle.geometry.coordinates import Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.signals import Interrupt


@dataclass(frozen=True, eq=False)
class Seen:
    view: View
    brightness: int


def plenty(_: int) -> int:
    return 150


@dataclass
class RectifiedMatcher:
    """``seconds`` for each pair; ``matches`` by the brightness of image 0; ``calls``: (long side, brightness)."""

    name: str = "rectified"
    seconds: float = 0.0
    matches: Callable[[int], int] = plenty
    calls: list[tuple[int, int]] = field(default_factory=list)

    @property
    def spec(self) -> MatcherSpec:
        return MatcherSpec(self.name, version="1")

    def encode(self, pictures: Sequence[Picture]) -> list[Seen]:
        return [Seen(picture.view, int(np.median(picture.pixels))) for picture in pictures]

    def match(self, encodings0: Sequence[Seen], encodings1: Sequence[Seen]) -> list[Matches]:
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        self.calls.append((max(seen0.view.content), seen0.brightness))
        # A matcher that takes no time would leave other workers without a pair.
        time.sleep(self.seconds)
        count = self.matches(seen0.brightness)
        # Other points for each pair and unit, and the same in every run.
        rng = np.random.default_rng(seen0.brightness + 1000 * max(seen0.view.content))
        points0 = rng.uniform(4, 60, (count, 2))
        points1 = points0 + np.column_stack([rng.uniform(0, 15, count), np.zeros(count)])
        scores = rng.uniform(size=count)
        return Matches(seen0.view.from_image(points0), seen1.view.from_image(points1), scores)


# A unit of stage 2 between two of stage 1: the third changes the crops of the second.
SWEEP = Unit(1, "rectified", 96)
SECOND = Unit(2, "rectified", 128)
THIRD = Unit(1, "rectified", 160)
THREE_UNITS = Recipe((SWEEP, SECOND, THIRD))
SIZE = Size(80, 72)


def write_pairs(directory: Path, count: int) -> list[Pair]:
    """Pairs of flat 80 x 72 images. Each pair has another brightness: 10, 11, ..."""
    pairs = []
    directory.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        paths = [str(directory / f"{index:03d}_{side}.png") for side in (0, 1)]
        # The brightness is all that the matcher knows of a pair.
        for path in paths:
            cv2.imwrite(path, np.full((72, 80, 3), 10 + index, np.uint8))
        pairs.append(Pair(f"set;{index:03d}", "set", *paths))
    return pairs


def flat(number: int, size: Size = SIZE) -> np.ndarray:
    # A matcher sees pixels only; `number_of` reads the number from them.
    return np.full((size.height, size.width, 3), 10 + 10 * number, np.uint8)


def number_of(seen: Seen) -> int:
    return seen.brightness // 10 - 1


def batch_pairs(
    directory: Path, images: int = 4, batch: str = "one", size: Size = SIZE
) -> list[Pair]:
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{number}.png" for number in range(images)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), flat(number, size))
    chosen = combinations(range(images), 2)
    return [Pair(f"{batch};{i}-{j}", batch, str(paths[i]), str(paths[j])) for i, j in chosen]


def run(
    pairs: Sequence[Pair],
    recipe: Recipe,
    matcher: RectifiedMatcher,
    work_dir: Path,
    *,
    limit: float = float("inf"),
    budget: Budget | None = None,
    interrupt: Interrupt | None = None,
    publish: Callable[..., None] = lambda *_: None,
    output: Path | None = None,
    workers: int | str | None = 0,
    is_watched: bool = False,
    more: Sequence[RectifiedMatcher] = (),
) -> Results:
    """Run the recipe with these matchers; the submission is written to ``output``, or given to
    ``publish``.
    """
    assembly = assemble(
        recipe, matchers={each.name: each for each in (matcher, *more)}, device="cpu"
    )
    budget = budget or Budget(time.monotonic(), limit)
    session = Session(
        work_dir, budget, interrupt or Interrupt(), progress=False, workers=workers
    )
    with session.watched() if is_watched else nullcontext():
        if output is not None:
            return submit(pairs, assembly, session, output)
        return run_pairs(pairs, assembly, session, publish=publish)


def matrices(report: Results) -> list[bytes]:
    """The bytes of each pair's own F."""
    return [np.array(F).tobytes() for F in report.pairs["own"]]


def sources(report: Results) -> list[str]:
    """Where the written F of each pair comes from."""
    return report.pairs["source"].tolist()
