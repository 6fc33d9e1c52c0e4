"""A run for reports: a snapshot of its journal, and the tables of the summary, the page and the exports."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path

import numpy as np
import pandas as pd

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.outputs import replacing, require_table
from mkpc_kaggle.engine.journal_reader import About, Event, EventKind, JournalReader, undamaged
from mkpc_kaggle.engine.records import PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.errors import writing
from mkpc_kaggle.geometry.coordinates import Box
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, sampson_distances
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of

MAX_DRAWN_PAIRS = 20  # the weakest, which the report draws
SECONDS = {  # names of the parts of a pair's work
    "decode_seconds": "wait for decoding",
    "encode_seconds": "encode",
    "match_seconds": "match",
    "cluster_seconds": "cluster",
    "estimate_seconds": "MAGSAC (in parallel with matching)",
}
VALUES: dict[str, type] = {  # of a pair, as attributes of its record
    **{"failure": object, "source": object, "matches": int, "inliers": int, "overlaps": bool},
    **dict.fromkeys(SECONDS, float),
    **{"stats.support": float, "stats.candidates": int, "stats.cost": float, "stats.magsac_cost": float},
}
PAIR_COLUMNS = {"pair": int, "id": str, "group": str, **{key.split(".")[-1]: VALUES[key] for key in VALUES}}
PAIR_COLUMNS |= dict.fromkeys(("focal0", "focal1", *(f"f{i}{j}" for i in "123" for j in "123")), float)
UNIT_COLUMNS = {"pair": int, **UnitRecord.__annotations__}
REGION_COLUMNS = {"pair": int, "image": int, **Box.__annotations__, "reason": str, "clusters": int, "kept": int}


@dataclass(frozen=True, eq=False)
class RunTables:
    """Long tables: pairs; units on pairs; critical regions, two for a pair. ``pair`` is the row of the test set.

    Seconds are of work, boxes are in image pixels.
    """

    pairs: pd.DataFrame
    units: pd.DataFrame
    regions: pd.DataFrame

    @property
    def solved(self) -> pd.DataFrame:
        """The pairs with an F, from their matches or their scene."""
        return self.pairs[self.pairs["source"] != "fallback"]

    @property
    def failed(self) -> pd.DataFrame:
        return self.pairs[self.pairs["source"] == "fallback"]

    @property
    def unit_means(self) -> pd.DataFrame:
        """Each ``unit``, the number of ``pairs`` it ran on, its mean ``matches``, ``inliers`` and ``seconds``."""
        units = self.units.assign(seconds=self.units["encode_seconds"] + self.units["match_seconds"])
        means = {name: (name, "mean") for name in ("matches", "inliers", "seconds")}
        return units.groupby("unit", sort=False).agg(pairs=("pair", "size"), **means).reset_index()

    def unit_reasons(self, column: str = "failure") -> list[str]:
        """Return why units failed or, by ``note``, ran otherwise, and on how many pairs; most frequent first."""
        noted = self.units[self.units[column] != ""]
        counts = (noted["unit"] + ": " + noted[column]).value_counts()
        return [f"{reason} ({count} pairs)" for reason, count in counts.items()]

    @property
    def region_reasons(self) -> list[str]:
        """How many critical regions were chosen for each reason; most frequent first."""
        return [f"{count} {reason}" for reason, count in self.regions["reason"].value_counts().items()]

    @property
    def seconds_by_part(self) -> dict[str, float]:
        """Seconds of each part of the work on all pairs."""
        return {name: float(self.pairs[column].sum()) for column, name in SECONDS.items()}


@dataclass(frozen=True, eq=False)
class WeakPair:
    """A pair with few inliers, with its matches and its F by MAGSAC."""

    record: PairRecord
    match: PairMatch


@dataclass(frozen=True, eq=False)
class RunLog:
    path: Path  # of the journal
    about: About
    recipe: Recipe
    pairs: tuple[Pair, ...]
    records: tuple[PairRecord, ...]  # of each pair, in order
    events: tuple[Event, ...]  # of all sessions
    weakest: tuple[WeakPair, ...]  # of the pairs that were matched, the fewest inliers first
    scenes: tuple[SceneRecord, ...] = ()

    @cached_property
    def tables(self) -> RunTables:
        return run_tables(self.pairs, self.records)

    @property
    def session(self) -> tuple[Event, ...]:
        """The events since the run was last started."""
        starts = [index for index, event in enumerate(self.events) if event.kind == EventKind.START]
        return self.events[starts[-1] :] if starts else self.events

    @property
    def ending(self) -> str:
        ends = [event.text for event in self.session if event.kind == EventKind.END]
        return ends[-1] if ends else "not ended (at work, or killed)"

    @property
    def seconds(self) -> float:
        """Duration of the last session until its last event."""
        return max((event.seconds for event in self.session), default=0.0)

    @property
    def faults(self) -> list[str]:
        return [event.text for event in self.events if event.kind == EventKind.FAULT]

    def named_tables(self) -> dict[str, pd.DataFrame]:
        """Return the tables by name, as they are exported."""
        pairs = self.tables.pairs.copy(deep=False)
        for side in (0, 1):  # only here: of a million pairs they take 300 MB
            pairs.insert(3 + side, f"image{side}", [pair.names[side] for pair in self.pairs])
        events = _table(map(astuple, self.events), Event.__annotations__)
        return {"pairs": pairs, "units": self.tables.units, "regions": self.tables.regions, "events": events}


def run_tables(pairs: Sequence[Pair], records: Sequence[PairRecord]) -> RunTables:
    """Return the tables of a run: a record for each pair, in the same order."""
    values = attrgetter(*VALUES)
    of_pairs = (
        (r.index, pair.id, pair.group, *values(r), *r.stats.focals, *r.chosen_fundamental.flat)
        for pair, r in zip(pairs, records, strict=True)
    )
    units = ((r.index, *astuple(unit)) for r in records for unit in r.units)
    regions = (
        (r.index, image, *astuple(region.box), str(region.reason), region.clusters, region.kept)
        for r in records
        for image, region in enumerate(r.regions or ())
    )
    return RunTables(_table(of_pairs, PAIR_COLUMNS), _table(units, UNIT_COLUMNS), _table(regions, REGION_COLUMNS))


def _table(rows: Iterable[tuple[object, ...]], columns: Mapping[str, type]) -> pd.DataFrame:
    """Stream the rows, since a run may have a million."""
    kinds = [(name, object if kind is str else kind) for name, kind in columns.items()]
    return pd.DataFrame(np.fromiter(rows, np.dtype(kinds)))


def read_log(directory: Path) -> RunLog:
    """Read the journal of a work directory, during a run or after it.

    Raises :class:`UserError` for a missing journal, and for one that this version cannot read.
    """
    with JournalReader(directory) as journal, undamaged(journal.path):
        about, pairs, records = journal.about(), journal.pairs(), tuple(journal.records())
        table = dict(about.recipe)
        recipe = recipe_of(table, table.pop("name"))
        touched = sorted((record for record in records if record.units), key=lambda r: (r.inliers, r.index))
        units = {unit.name: unit for unit in recipe.units}

        def weak(record: PairRecord) -> WeakPair:
            inputs, F = journal.inputs(record.index), record.pair_fundamental
            points = journal.points(inputs.values())
            results = tuple(UnitResult(units[name], points[inputs[name]]) for name in inputs)
            distances = sampson_distances(F, Matches.concatenate(points.values()))
            inliers = (distances < recipe.magsac.threshold) & (not record.failure)
            estimate = Estimate(ModelKind.F, F, inliers, record.failure)
            return WeakPair(record, PairMatch(results, record.regions, estimate))

        weakest, scenes = tuple(map(weak, touched[:MAX_DRAWN_PAIRS])), tuple(journal.scenes().values())
        return RunLog(journal.path, about, recipe, pairs, records, journal.events(), weakest, scenes)


def write_csv(log: RunLog, directory: Path) -> list[Path]:
    """Write each table to a file of its name. Return the files.

    Only tables with the same columns are replaced. Raises :class:`UserError` for other files of these names, and
    if a table cannot be written.
    """
    tables = {directory / f"{name}.csv": table for name, table in log.named_tables().items()}
    with writing(f"--csv {directory}"):
        directory.mkdir(parents=True, exist_ok=True)
        for path, table in tables.items():
            require_table(path, table.columns)
        for path, table in tables.items():
            with replacing(path) as stream:
                table.to_csv(stream, index=False)
    return list(tables)
