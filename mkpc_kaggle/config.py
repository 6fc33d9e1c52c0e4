"""Frozen dataclasses from TOML tables: every key is known, every value has its type and is in its range."""

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields
from enum import StrEnum
from typing import Any, TypeVar, get_type_hints

from mkpc_kaggle.errors import UserError

Config = TypeVar("Config")


def from_table(cls: type[Config], table: Mapping[str, Any], where: str) -> Config:
    """Build the dataclass ``cls`` from a TOML table.

    ``where`` names the table in messages. Raises :class:`UserError` for an unknown key (listing the known
    ones), a missing one, a value of another type, or one that the dataclass refuses with a ``ValueError``.
    """
    known: dict[str, Field[Any]] = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    check_keys(table, known, where)
    missing = [
        name
        for name, field in known.items()
        if name not in table and field.default is MISSING and field.default_factory is MISSING
    ]
    if missing:
        raise UserError(f"{where} lacks {', '.join(map(repr, missing))}")
    hints = get_type_hints(cls)
    values = {key: convert(value, hints[key], f"{where}, key {key!r}") for key, value in table.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error


def check_keys(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Raise :class:`UserError` for what is no table, and for the first key that is not among ``known``."""
    if not isinstance(table, Mapping):
        raise UserError(f"{where} must be a table, not {table!r}")
    known = list(known)
    for key in table:
        if key not in known:
            raise UserError(f"{where} has the unknown key {key!r}; known keys: {', '.join(known)}")


def convert(value: Any, kind: type, where: str) -> Any:
    """``value`` as ``kind`` (int, float, bool, str or an enum of strings), or :class:`UserError`."""
    if issubclass(kind, StrEnum):
        if value not in list(kind):
            raise UserError(f"{where}: {value!r} is none of {', '.join(repr(str(one)) for one in kind)}")
        return kind(value)
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise UserError(f"{where}: expected {kind.__name__}, got {value!r}")
    return value
