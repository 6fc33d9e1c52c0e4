"""How a dataclass is a table of SQLite: a column for each field, by the field's type."""

import json
import sqlite3
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import isfinite
from operator import attrgetter, index
from types import NoneType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from mkpc_kaggle.engine.store.json_values import json_reader_of, to_text, without_alias
from mkpc_kaggle.errors import printable
from mkpc_kaggle.scene.models import SfmModel

T = TypeVar("T")


@dataclass(frozen=True)
class Column:
    """A column, and the two directions of its conversion; ``None`` if SQLite returns the value itself."""

    name: str
    declaration: str
    to_sql: Callable[[Any], Any]
    of_sql: Callable[[Any], Any] | None


@dataclass(frozen=True)
class Layout(Generic[T]):
    """The table of a dataclass. ``facts`` are all columns besides ``data``, if any.

    The facts are the first fields of the dataclass, in this order.
    """

    kind: Callable[..., T]
    table: str
    key: str
    facts: tuple[Column, ...]
    has_data: bool

    @property
    def names(self) -> str:
        return ", ".join(column.name for column in self.facts)

    @property
    def sql(self) -> str:
        """The statement that creates the table.

        STRICT refuses values of a wrong type, which would be noticed only when a report is made.
        """
        lines = [
            f"{column.name} {column.declaration}{' PRIMARY KEY' * (column.name == self.key)}"
            for column in self.facts
        ]
        lines += ["data BLOB NOT NULL"] * self.has_data
        columns = ",\n    ".join([*lines, "checksum BLOB NOT NULL"])
        return f"CREATE TABLE {self.table} (\n    {columns}\n) STRICT"

    def values(self, row: T) -> tuple[Any, ...]:
        """Return the facts as SQLite has them. Raise ``sqlite3.IntegrityError`` for other numbers than
        the columns are for, or numbers that are not finite.
        """
        try:
            pairs = zip(self._to_sql, self._fields(row), strict=True)
            return tuple([convert(value) for convert, value in pairs])
        except (TypeError, ValueError) as error:
            raise sqlite3.IntegrityError(f"{self.table}: {error}") from error

    def row(self, values: Sequence[Any]) -> T:
        """Return the row with these facts, without its data."""
        # Few columns need a conversion, and a start of a run reads all rows.
        row = list(values)
        for number, convert in self._conversions:
            row[number] = convert(row[number])
        return self.kind(*row)

    # Computed once, since a run converts each row of its results

    @cached_property
    def _to_sql(self) -> list[Callable[[Any], Any]]:
        return [column.to_sql for column in self.facts]

    @cached_property
    def _fields(self) -> Callable[[T], tuple[Any, ...]]:
        return attrgetter(*(column.name for column in self.facts))

    @cached_property
    def _conversions(self) -> list[tuple[int, Callable[[Any], Any]]]:
        found = []
        for number, column in enumerate(self.facts):
            if column.of_sql is not None:
                found.append((number, column.of_sql))
        return found


def _finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError(f"{value} is no number")
    return float(value)  # also for NumPy's float32


def _text(value: str) -> str:
    text = str(value)  # of an enum, too
    return text if text.isascii() else printable(text)


# 16 characters a point; as decimal digits, the points would be most of a large store.
def _models_to_sql(models: Sequence[SfmModel]) -> str:
    return to_text(
        [
            {
                "images": model.images,
                "points": b64encode(model.points.astype("<f4").tobytes()).decode("ascii"),
                "reprojection_error": float(model.reprojection_error),
            }
            for model in models
        ]
    )


def _models_of_sql(text: str) -> tuple[SfmModel, ...]:
    read = json_reader_of(SfmModel)
    assert read is not None
    models = []
    for about in json.loads(text):
        points = np.frombuffer(b64decode(about.pop("points")), "<f4").reshape(-1, 3)
        model = read({**about, "points": []})
        models.append(replace(model, points=points.astype(np.float64)))
    return tuple(models)


PLAIN: dict[Any, tuple[str, Callable[[Any], Any], Callable[[Any], Any] | None]] = {
    str: ("TEXT", _text, None),
    int: ("INTEGER", index, None),
    float: ("REAL", _finite, None),
    bool: ("INTEGER", int, bool),
    tuple[SfmModel, ...]: ("TEXT", _models_to_sql, _models_of_sql),
}


def _unless_none(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else convert(value)


def _column(name: str, hint: Any) -> Column:
    hint = without_alias(hint)
    if NoneType in get_args(hint):
        (known,) = set(get_args(hint)) - {NoneType}
        column = _column(name, known)
        declaration = column.declaration.removesuffix(" NOT NULL")
        of_sql = column.of_sql and _unless_none(column.of_sql)
        return Column(name, declaration, _unless_none(column.to_sql), of_sql)
    if hint in PLAIN:
        kind, to_sql, of_sql = PLAIN[hint]
        return Column(name, f"{kind} NOT NULL", to_sql, of_sql)
    if get_origin(hint) is np.ndarray:
        # A matrix of float64
        return Column(
            name,
            "BLOB NOT NULL",
            lambda matrix: np.asarray(matrix, "<f8").tobytes(),
            lambda data: np.frombuffer(data, "<f8").reshape(3, 3),
        )
    read = _reader(json_reader_of(hint))
    if get_origin(hint) is tuple:
        # Most are empty, such as the regions of a unit of stage 1.
        return Column(
            name, "TEXT NOT NULL", to_text, lambda text: () if text == "[]" else read(text)
        )
    return Column(name, "TEXT NOT NULL", to_text, read)


def _reader(read: Callable[[Any], Any] | None) -> Callable[[str], Any]:
    # Without the search for white space of json.loads
    decode = json.JSONDecoder().raw_decode
    if read is None:
        return lambda text: decode(text)[0]
    return lambda text: read(decode(text)[0])


def layout_of(kind: type[T], table: str, key: str) -> Layout[T]:
    """Return the layout of a dataclass. A field with ``is_stored=False`` in its metadata is no column."""
    hints = get_type_hints(kind)
    stored = [each for each in fields(kind) if each.metadata.get("is_stored", True)]  # type: ignore[arg-type]
    names = [each.name for each in stored]
    facts = tuple(_column(name, hints[name]) for name in names if name != "data")
    return Layout(kind, table, key, facts, "data" in names)
