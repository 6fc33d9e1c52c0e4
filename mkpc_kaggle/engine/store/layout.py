"""How a dataclass is a table of SQLite: a column for each field, by the field's type."""

import json
import sqlite3
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from types import NoneType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from mkpc_kaggle.engine.store.json_values import as_json, from_json
from mkpc_kaggle.errors import printable
from mkpc_kaggle.scene.models import SfmModel

T = TypeVar("T")


@dataclass(frozen=True)
class Column:
    """A column, and the two directions of its conversion."""

    name: str
    declaration: str
    to_sql: Callable[[Any], Any]
    of_sql: Callable[[Any], Any]


@dataclass(frozen=True)
class Layout(Generic[T]):
    """The table of a dataclass. ``facts`` are all columns besides ``data``, if there is such a column."""

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
        """Return the facts as SQLite has them. Raise ``sqlite3.IntegrityError`` for a number that is
        not finite.
        """
        try:
            return tuple(column.to_sql(getattr(row, column.name)) for column in self.facts)
        except ValueError as error:
            raise sqlite3.IntegrityError(f"{self.table}: {error}") from error

    def row(self, values: Sequence[Any]) -> T:
        """Return the row with these facts, without its data."""
        pairs = zip(self.facts, values, strict=True)
        return self.kind(**{column.name: column.of_sql(value) for column, value in pairs})


def _same(value: Any) -> Any:
    return value


def _finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError(f"{value} is no number")
    return float(value)  # also for NumPy's float32


def _dumps(value: Any) -> str:
    return printable(json.dumps(as_json(value), allow_nan=False))


# 16 characters a point; as decimal digits, the points would be most of a large store.
def _models_to_sql(models: Sequence[SfmModel]) -> str:
    return _dumps(
        [
            {
                "images": model.images,
                "points": b64encode(model.points.astype("<f4").tobytes()).decode("ascii"),
                "reprojection_error": float(model.reprojection_error),
                "comparison": model.comparison,
            }
            for model in models
        ]
    )


def _models_of_sql(text: str) -> tuple[SfmModel, ...]:
    models = []
    for about in json.loads(text):
        points = np.frombuffer(b64decode(about.pop("points")), "<f4").reshape(-1, 3)
        model: SfmModel = from_json(SfmModel, {**about, "points": []})
        models.append(replace(model, points=points.astype(np.float64)))
    return tuple(models)


PLAIN: dict[Any, tuple[str, Callable[[Any], Any], Callable[[Any], Any]]] = {
    str: ("TEXT", printable, _same),
    int: ("INTEGER", _same, _same),
    float: ("REAL", _finite, _same),
    bool: ("INTEGER", int, bool),
    tuple[SfmModel, ...]: ("TEXT", _models_to_sql, _models_of_sql),
}


def _column(name: str, hint: Any) -> Column:
    if NoneType in get_args(hint):
        (known,) = set(get_args(hint)) - {NoneType}
        column = _column(name, known)
        return Column(
            name,
            column.declaration.removesuffix(" NOT NULL"),
            lambda value: None if value is None else column.to_sql(value),
            lambda value: None if value is None else column.of_sql(value),
        )
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
    return Column(name, "TEXT NOT NULL", _dumps, lambda text: from_json(hint, json.loads(text)))


def layout_of(kind: type[T], table: str, key: str) -> Layout[T]:
    """Return the layout of a dataclass. A field with ``is_stored=False`` in its metadata is no column."""
    hints = get_type_hints(kind)
    stored = [each for each in fields(kind) if each.metadata.get("is_stored", True)]  # type: ignore[arg-type]
    names = [each.name for each in stored]
    facts = tuple(_column(name, hints[name]) for name in names if name != "data")
    return Layout(kind, table, key, facts, "data" in names)
