"""Rows as the store's file has them: their values, with a checksum, and matches as bytes."""

import marshal
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mkpc_kaggle.engine.store.layout import Layout
from mkpc_kaggle.engine.store.tables import LAYOUTS
from mkpc_kaggle.geometry.matches import Matches

CHECKSUM_BYTES = 4  # of each part of a row: its facts, and its data if it has any
FACTS = slice(CHECKSUM_BYTES)  # the parts of a row's checksum
DATA = slice(CHECKSUM_BYTES, None)
FACTS_BYTES = 500  # of a row, about
RowKey = tuple[str, Any]  # a table, and the key of a row in it


@dataclass(frozen=True, eq=False)
class StoredRow:
    """A row, its table, and its values there: facts, data if there is any, and the checksum."""

    row: Any
    layout: Layout[Any]
    values: tuple[Any, ...]

    @classmethod
    def of(cls, row: Any) -> "StoredRow":
        layout = LAYOUTS[type(row)]
        values = layout.values(row)
        if layout.has_data:
            values += (row.data,)
        return cls(row, layout, (*values, checksum_of(layout, values)))

    @property
    def key(self) -> RowKey:
        return self.layout.table, getattr(self.row, self.layout.key)

    @property
    def facts(self) -> tuple[Any, ...]:
        return self.values[: len(self.layout.facts)]

    @property
    def size(self) -> int:
        """The bytes of the row, about."""
        return FACTS_BYTES + (len(self.row.data) if self.layout.has_data else 0)


def by_table(rows: Iterable[StoredRow]) -> dict[str, list[tuple[Any, ...]]]:
    """Return the values of rows by the name of their table."""
    values: dict[str, list[tuple[Any, ...]]] = {}
    for row in rows:
        values.setdefault(row.layout.table, []).append(row.values)
    return values


def checksum_of(layout: Layout[Any], values: Sequence[Any]) -> bytes:
    """Return the checksum of a row's values: facts, and data if the table has any."""
    if not layout.has_data:
        return facts_checksum(layout, values)
    *facts, data = values
    # Of results with data, the first column is the key.
    return facts_checksum(layout, facts) + data_checksum(layout, facts[0], data)


def facts_checksum(layout: Layout[Any], facts: Sequence[Any]) -> bytes:
    # Against accidents; a cryptographic digest would take four times as long, at each start of a run.
    # In version 2, marshal has the same bytes for equal values, and is ten times as fast as a text.
    content = marshal.dumps((layout.table, *facts), 2)
    return zlib.crc32(content).to_bytes(CHECKSUM_BYTES, "little")


def data_checksum(layout: Layout[Any], key: str, data: bytes) -> bytes:
    # With the key, so that data cannot be exchanged
    start = zlib.crc32(f"{layout.table}\n{key}\n".encode())
    return zlib.crc32(data, start).to_bytes(CHECKSUM_BYTES, "little")


def to_bytes(matches: Matches) -> bytes:
    """Return the bytes of x0, y0, x1, y1 and score of each match, as little-endian float32."""
    # Exact, because workers return float32.
    columns = [matches.points0, matches.points1, matches.scores]
    return np.column_stack(columns).astype("<f4").tobytes()


def from_bytes(data: bytes) -> Matches:
    """Invert :func:`to_bytes`."""
    table = np.frombuffer(data, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])
