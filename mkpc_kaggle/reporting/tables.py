"""A run as four tables, which the summary, the report and the exports count on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import pandas as pd

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.journal_reader import Event
from mkpc_kaggle.engine.records import PairRecord, UnitRecord

F_COLUMNS = tuple(f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
SECONDS = {  # names of the parts of a pair's work; MAGSAC runs in parallel with the others
    "decode_seconds": "wait for decoding",
    "encode_seconds": "encode",
    "match_seconds": "match",
    "cluster_seconds": "cluster",
    "estimate_seconds": "MAGSAC (beside matching)",
}
_COLUMNS = {
    **{"failure": object, "source": object, "matches": int, "inliers": int, "overlaps": bool},
    **dict.fromkeys(SECONDS, float),
}
_STATS_COLUMNS = {"support": float, "candidates": int, "cost": float, "magsac_cost": float}
_UNIT_COLUMNS = {"pair": int, **UnitRecord.__annotations__}
_BOX_COLUMNS = dict.fromkeys(("pair", "image", "left", "top", "right", "bottom"), int)
_REGION_COLUMNS = {**_BOX_COLUMNS, "reason": str, "clusters": int, "kept": int}


@dataclass(frozen=True, eq=False)
class RunTables:
    """Long tables: pairs; units on pairs; critical regions, two for a pair; events.

    ``pair`` is the row of ``test_set``. Seconds are of work, boxes are in image pixels.
    """

    pairs: pd.DataFrame
    units: pd.DataFrame
    regions: pd.DataFrame
    events: pd.DataFrame
    test_set: Sequence[Pair]

    @property
    def solved(self) -> pd.DataFrame:
        """The pairs with an F, from their matches or their scene."""
        return self.pairs[self.pairs["source"] != "fallback"]

    @property
    def failed(self) -> pd.DataFrame:
        return self.pairs[self.pairs["source"] == "fallback"]

    def named(self) -> dict[str, pd.DataFrame]:
        """The tables by name, as they are exported."""
        pairs = self.pairs.copy(deep=False)
        for side in (0, 1):  # only here: of a million pairs they take 300 MB
            pairs.insert(3 + side, f"image{side}", [pair.names[side] for pair in self.test_set])
        return {"pairs": pairs, "units": self.units, "regions": self.regions, "events": self.events}


def run_tables(pairs: Sequence[Pair], records: Sequence[PairRecord], events: Sequence[Event] = ()) -> RunTables:
    """The tables of a run: a record for each pair, in the same order."""
    return RunTables(
        _pair_table(pairs, records),
        _table(((r.index, *astuple(unit)) for r in records for unit in r.units), _UNIT_COLUMNS),
        _table(_region_rows(records), _REGION_COLUMNS),
        _table(map(astuple, events), Event.__annotations__),
        pairs,
    )


def unit_means(tables: RunTables) -> pd.DataFrame:
    """Each ``unit``, how many ``pairs`` it ran on, and its mean ``matches``, ``inliers`` and ``seconds`` there."""
    units = tables.units.assign(seconds=tables.units["encode_seconds"] + tables.units["match_seconds"])
    by_unit = units.groupby("unit", sort=False)
    means = by_unit[["matches", "inliers", "seconds"]].mean()
    means.insert(0, "pairs", by_unit.size())
    return means.reset_index()


def unit_reasons(tables: RunTables, column: str = "failure") -> list[str]:
    """Why units failed (``failure``) or ran otherwise (``note``), on how many pairs; the most frequent first."""
    noted = tables.units[tables.units[column] != ""]
    counts = (noted["unit"] + ": " + noted[column]).value_counts()
    return [f"{reason} ({count} pairs)" for reason, count in counts.items()]


def seconds_by_part(tables: RunTables) -> dict[str, float]:
    """Seconds that each part of the work took on all pairs."""
    return {name: float(tables.pairs[column].sum()) for column, name in SECONDS.items()}


def _table(rows: Iterator[tuple[object, ...]], columns: Mapping[str, type]) -> pd.DataFrame:
    # Without a row pandas would not know the columns' types.
    return pd.DataFrame(list(rows), columns=list(columns)).astype(dict(columns))


def _pair_table(pairs: Sequence[Pair], records: Sequence[PairRecord]) -> pd.DataFrame:
    """Build the table by columns: a tuple per row takes a kilobyte, and a run may have a million rows."""
    size = len(pairs)
    columns: dict[str, Any] = {
        "pair": np.fromiter((record.index for record in records), int, size),
        "id": np.fromiter((pair.id for pair in pairs), object, size),
        "group": np.fromiter((pair.group for pair in pairs), object, size),
    }
    for name, kind in _COLUMNS.items():
        columns[name] = np.fromiter((getattr(record, name) for record in records), kind, size)
    for name, kind in _STATS_COLUMNS.items():
        columns[name] = np.array([getattr(record.stats, name) for record in records], kind)
    focals = np.array([record.stats.focals for record in records]).reshape(size, 2)
    columns |= {"focal0": focals[:, 0], "focal1": focals[:, 1]}
    F = np.array([record.chosen_fundamental for record in records]).reshape(size, 9)
    columns |= dict(zip(F_COLUMNS, F.T, strict=True))
    return pd.DataFrame(columns, copy=False)


def _region_rows(records: Sequence[PairRecord]) -> Iterator[tuple[object, ...]]:
    for record in records:
        for image, region in enumerate(record.regions or ()):
            box = region.box
            edges = (box.left, box.top, box.right, box.bottom)
            yield (record.index, image, *edges, str(region.reason), region.clusters, region.kept)
