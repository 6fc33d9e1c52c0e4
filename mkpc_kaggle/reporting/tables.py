"""A run as four tables: all that the summary, the report and the exports count is counted on these."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.journal_tables import Event
from mkpc_kaggle.engine.records import PairRecord

F_COLUMNS = tuple(f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
SECONDS = ("decode_seconds", "encode_seconds", "match_seconds", "cluster_seconds", "estimate_seconds")

_PAIRS = {
    **{"pair": int, "id": str, "group": str, "image0": str, "image1": str, "failure": str, "source": str},
    **{"matches": int, "inliers": int, **dict.fromkeys(SECONDS, float), **dict.fromkeys(F_COLUMNS, float)},
}
_UNITS = {
    **{"pair": int, "unit": str, "stage": int, "matches": int, "inliers": int},
    **{"encode_seconds": float, "match_seconds": float, "failure": str},
}
_REGIONS = {
    **{"pair": int, "image": int, "left": int, "top": int, "right": int, "bottom": int},
    **{"reason": str, "clusters": int, "kept": int},
}
_EVENTS = {"kind": str, "seconds": float, "text": str}


@dataclass(frozen=True, eq=False)
class RunTables:
    """Long tables, a row a pair, a unit on a pair, an image of a pair that was looked at for its critical region,
    and an event; ``pair`` is the row of the test set. Seconds are of work, boxes and points in image pixels.
    """

    pairs: pd.DataFrame
    units: pd.DataFrame
    regions: pd.DataFrame
    events: pd.DataFrame

    @property
    def solved(self) -> pd.DataFrame:
        """The pairs that have an F, of their own or of their scene."""
        return self.pairs[self.pairs["source"] != "fallback"]

    @property
    def failed(self) -> pd.DataFrame:
        """The pairs that have the fallback row."""
        return self.pairs[self.pairs["source"] == "fallback"]

    def named(self) -> dict[str, pd.DataFrame]:
        """The tables by name, as they are exported."""
        return {"pairs": self.pairs, "units": self.units, "regions": self.regions, "events": self.events}


def run_tables(pairs: Sequence[Pair], records: Sequence[PairRecord], events: Sequence[Event] = ()) -> RunTables:
    """The tables of a run: one record a pair, in their order."""
    return RunTables(
        _pair_table(pairs, records),
        _table(_unit_rows(records), _UNITS),
        _table(_region_rows(records), _REGIONS),
        _table(((event.kind, event.seconds, event.text) for event in events), _EVENTS),
    )


def unit_means(tables: RunTables) -> pd.DataFrame:
    """A row a unit that ran: on how many ``pairs``, and the means of ``matches``, ``inliers`` and ``seconds``."""
    units = tables.units.assign(seconds=tables.units["encode_seconds"] + tables.units["match_seconds"])
    by_unit = units.groupby("unit")
    return by_unit[["matches", "inliers", "seconds"]].mean().assign(pairs=by_unit.size())


def unit_failures(tables: RunTables) -> list[str]:
    """Why units failed, and on how many pairs; the most frequent reason first."""
    failed = tables.units[tables.units["failure"] != ""]
    counts = (failed["unit"] + ": " + failed["failure"]).value_counts()
    return [f"{reason} ({count} pairs)" for reason, count in counts.items()]


def seconds_by_part(tables: RunTables) -> dict[str, float]:
    """What the parts of the work took in all: the first four one after the other, MAGSAC beside them."""
    names = ("wait for decoding", "encode", "match", "cluster", "MAGSAC (beside matching)")
    return {name: float(tables.pairs[part].sum()) for name, part in zip(names, SECONDS, strict=True)}


def to_json(tables: RunTables) -> dict[str, list[dict[str, Any]]]:
    """``pairs``, each with its F and the rows of its ``units`` and ``regions``, and ``events``."""
    pairs: list[dict[str, Any]] = _rows(tables.pairs.drop(columns=list(F_COLUMNS)))
    for pair, F in zip(pairs, tables.pairs[list(F_COLUMNS)].to_numpy(), strict=True):
        pair |= {"F": F.reshape(3, 3).tolist(), "units": [], "regions": []}
    for name in ("units", "regions"):
        for row in _rows(tables.named()[name]):
            pairs[row.pop("pair")][name].append(row)
    return {"pairs": pairs, "events": _rows(tables.events)}


def _rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = table.to_dict("records")  # type: ignore[assignment]  # keys are column names
    return rows


def _table(rows: Iterator[tuple[object, ...]], columns: dict[str, type]) -> pd.DataFrame:
    # Without a row pandas would not know the columns' types.
    return pd.DataFrame(list(rows), columns=list(columns)).astype(columns)


def _pair_table(pairs: Sequence[Pair], records: Sequence[PairRecord]) -> pd.DataFrame:
    """Column by column: a row as a tuple of its own takes a kilobyte, and there may be a million."""
    encode = [sum((unit.encode_seconds for unit in record.units), 0.0) for record in records]
    match = [sum((unit.match_seconds for unit in record.units), 0.0) for record in records]
    columns: dict[str, Any] = {
        "pair": [record.index for record in records],
        "id": [pair.id for pair in pairs],
        "group": [pair.group for pair in pairs],
        "image0": [sys.intern(pair.names[0]) for pair in pairs],
        "image1": [sys.intern(pair.names[1]) for pair in pairs],
        "failure": [record.failure for record in records],
        "source": [record.source for record in records],
        "matches": [record.matches for record in records],
        "inliers": [record.inliers for record in records],
        "decode_seconds": [record.decode_seconds for record in records],
        "encode_seconds": encode,
        "match_seconds": match,
        "cluster_seconds": [record.cluster_seconds for record in records],
        "estimate_seconds": [record.estimate_seconds for record in records],
    }
    F = np.array([record.fundamental for record in records], np.float64).reshape(-1, len(F_COLUMNS))
    columns |= dict(zip(F_COLUMNS, F.T, strict=True))
    table = pd.DataFrame(columns)
    return table if len(table) else table.astype(_PAIRS)  # which would copy all of it


def _unit_rows(records: Sequence[PairRecord]) -> Iterator[tuple[object, ...]]:
    for record in records:
        for unit in record.units:
            counts = (unit.matches, unit.inliers, unit.encode_seconds, unit.match_seconds)
            yield (record.index, unit.unit, unit.stage, *counts, unit.failure)


def _region_rows(records: Sequence[PairRecord]) -> Iterator[tuple[object, ...]]:
    for record in records:
        for image, region in enumerate(record.regions or ()):
            box = region.box
            edges = (box.left, box.top, box.right, box.bottom)
            yield (record.index, image, *edges, str(region.reason), region.clusters, region.kept)
