"""A run as four tables: all that the summary, the report and the exports count is counted on these."""

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

_TEXTS = dict.fromkeys(("id", "group", "failure", "source"), str)
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
    and an event; ``pair`` is the row of ``test_set``. Seconds are of work, boxes and points in image pixels.
    """

    pairs: pd.DataFrame
    units: pd.DataFrame
    regions: pd.DataFrame
    events: pd.DataFrame
    test_set: Sequence[Pair]

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
        pairs = self.pairs.copy(deep=False)
        for side in (0, 1):  # only here: of a million pairs they take 300 MB
            pairs.insert(3 + side, f"image{side}", [pair.names[side] for pair in self.test_set])
        return {"pairs": pairs, "units": self.units, "regions": self.regions, "events": self.events}


def run_tables(pairs: Sequence[Pair], records: Sequence[PairRecord], events: Sequence[Event] = ()) -> RunTables:
    """The tables of a run: one record a pair, in their order."""
    return RunTables(
        _pair_table(pairs, records),
        _table(_unit_rows(records), _UNITS),
        _table(_region_rows(records), _REGIONS),
        _table(((event.kind, event.seconds, event.text) for event in events), _EVENTS),
        pairs,
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
    named = tables.named()
    pairs: list[dict[str, Any]] = _rows(named["pairs"].drop(columns=list(F_COLUMNS)))
    for pair, F in zip(pairs, tables.pairs[list(F_COLUMNS)].to_numpy(), strict=True):
        pair |= {"F": F.reshape(3, 3).tolist(), "units": [], "regions": []}
    for name in ("units", "regions"):
        for row in _rows(named[name]):
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
    size = len(pairs)
    columns: dict[str, Any] = {
        "pair": np.fromiter((record.index for record in records), int, size),
        "id": [pair.id for pair in pairs],
        "group": [pair.group for pair in pairs],
        "failure": [record.failure for record in records],
        "source": [record.source for record in records],
        "matches": np.fromiter((record.matches for record in records), int, size),
        "inliers": np.fromiter((record.inliers for record in records), int, size),
        "decode_seconds": np.fromiter((record.decode_seconds for record in records), float, size),
        "encode_seconds": np.fromiter((record.encode_seconds for record in records), float, size),
        "match_seconds": np.fromiter((record.match_seconds for record in records), float, size),
        "cluster_seconds": np.fromiter((record.cluster_seconds for record in records), float, size),
        "estimate_seconds": np.fromiter((record.estimate_seconds for record in records), float, size),
    }
    F = np.empty((len(F_COLUMNS), size))
    for place, record in enumerate(records):
        F[:, place] = record.fundamental.ravel()
    columns |= dict(zip(F_COLUMNS, F, strict=True))
    table = pd.DataFrame(columns, copy=False)
    return table if size else table.astype(_TEXTS)


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
