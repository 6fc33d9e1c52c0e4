"""The request of a run, its distinct pairs and batches, and the final report."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.console import Event
from mkpc_kaggle.engine.store.dataframes import PairTables
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.engine.store.tables import MIN_PAIRS, About, SceneRecord
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.recipe import Recipe

if TYPE_CHECKING:
    from mkpc_kaggle.engine.plan.state import State


class Ending(StrEnum):
    """Why a run ended."""

    COMPLETE = "complete"
    # Something was given up. All else is complete, and the next run tries it again.
    WITH_FAILURES = "ended with failures"
    TIME_IS_UP = "time is up"
    INTERRUPTED = "interrupted"
    NO_WORKER = "no worker left"
    NOTHING_RUNS = "every unit was skipped"

    @property
    def is_done(self) -> bool:
        """Whether the run has computed everything that it could."""
        return self in (Ending.COMPLETE, Ending.WITH_FAILURES)


@dataclass(frozen=True)
class Request:
    """A request for points, estimates and scenes of ``pairs``, whose images are below ``root``.

    ``cameras`` are the user's known cameras. ``exports`` are the directories for COLMAP's
    files, by batch. ``publish`` is called with the state, whose
    ``fundamentals``, ``scenes`` and ``digests`` are the results so far: at the start, every half minute (less
    often if slow), after each scene with files, and at the end. A trial is not the run's result: its table of
    pairs is not stored.
    """

    pairs: Sequence[Pair]
    recipe: Recipe
    keys: Keys
    root: str = ""
    cameras: Rows = ()
    exports: Mapping[str, Path] = field(default_factory=dict)
    about: About = field(default_factory=About)
    publish: "Callable[[State], None]" = lambda _: None
    is_trial: bool = False


@dataclass(frozen=True)
class RunReport:
    """The outcome of a run: tables with a row for each pair, in order, and how the run ended.

    ``resumed`` is the number of pairs that earlier runs finished. ``faults`` are lost jobs and unwritten files.
    ``unwritten`` says why the last version of the results could not be written.
    """

    tables: PairTables
    ending: Ending
    seconds: float
    resumed: int = 0
    faults: tuple[str, ...] = ()
    explanations: tuple[Event, ...] = ()  # decisions of the schedule
    unwritten: str = ""
    unsaved: str = ""  # why the journal does not have all results
    scenes: tuple[SceneRecord, ...] = ()
    units_run: int = 0
    units_failed: int = 0  # that raised
    estimated: int = 0
    log: Path | None = None  # the output of workers' libraries, if any
    # As About.files, and the digests of the contents of images in pairs, by name
    files: Mapping[str, Sequence[str]] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)


def distinct_pairs(rows: Iterable[Pair]) -> tuple[list[Pair], NDArray[np.int_]]:
    """Return the distinct pairs of a table, the first row of each, and the pair of each row.

    Rows of a batch with the same two images are one pair: they share its points and its estimate.
    """
    pairs: list[Pair] = []
    known: dict[Any, int] = {}
    pair_of_row = []
    for pair in rows:
        # With other intrinsics, another E is estimated.
        intrinsics = pair.intrinsics and tuple(K.tobytes() for K in pair.intrinsics)
        key = (pair.group, pair.file0, pair.file1, pair.turns, intrinsics)
        if key not in known:
            known[key] = len(pairs)
            pairs.append(pair)
        pair_of_row.append(known[key])
    return pairs, np.array(pair_of_row, int)


def names_of(pair: Pair, root: str) -> tuple[str, str]:
    """Return the paths of a pair's images below ``root``."""
    return name_below(root, pair.file0), name_below(root, pair.file1)


def name_below(root: str, file: str) -> str:
    """Return a file's path relative to ``root``, or the whole path if the file lies elsewhere."""
    return file.removeprefix(root.rstrip("/") + "/") if root else file


def batches_of(pairs: Iterable[Pair]) -> dict[str, list[int]]:
    """Return the pair indices of each batch that can be reconstructed: two or more pairs without
    intrinsics.
    """
    batches: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs):
        # With known intrinsics, a pair gets an E, which no scene can replace.
        if pair.intrinsics is None:
            batches.setdefault(pair.group, []).append(index)
    return {name: members for name, members in batches.items() if len(members) >= MIN_PAIRS}


def visiting_order(pairs: Sequence[Pair]) -> list[int]:
    """Return pair indices in an order that puts pairs with a common image together, for encoding
    cache hits.
    """
    # The group first: a batch that is finished early gets its scene early.
    keys = [(pair.group, pair.file0, pair.file1) for pair in pairs]
    return sorted(range(len(pairs)), key=keys.__getitem__)
