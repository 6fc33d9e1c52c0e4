"""Settings: frozen dataclasses from TOML tables, with checked keys and values."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from enum import StrEnum
from math import inf, isfinite
from typing import Any, TypeVar, get_type_hints

from mkpc_kaggle.errors import UserError

Config = TypeVar("Config")

DECIMAL = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
WHOLE = re.compile(r"\d{1,18}", re.ASCII)
MAX_INTEGER = 2**63 - 1  # as in TOML


def from_table(cls: type[Config], table: Mapping[str, Any], where: str) -> Config:
    """Build the dataclass ``cls`` from a TOML table.

    ``where`` names the table in messages. Raises :class:`UserError` for an unknown or missing key
    and for a wrong type; also for a value that the dataclass refuses with a ``ValueError``.
    """
    known: dict[str, Field[Any]] = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    check_keys(table, known, where)
    missing = []
    for name, field in known.items():
        is_required = field.default is MISSING and field.default_factory is MISSING
        if is_required and name not in table:
            missing.append(name)
    if missing:
        raise UserError(f"{where}: missing keys {', '.join(map(repr, missing))}")
    hints = get_type_hints(cls)
    values = {}
    for key, value in table.items():
        values[key] = convert(value, hints[key], f"{where}, key {key!r}")
    try:
        return cls(**values)
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error


def check_keys(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Raise :class:`UserError` if ``table`` is not a TOML table or has an unknown key."""
    if not isinstance(table, Mapping):
        raise UserError(f"{where} must be a table, not {table!r}")
    for key in table:
        if key not in known:
            raise UserError(
                f"{where} has the unknown key {key!r}; known keys: {', '.join(known)}"
            )


def convert(value: Any, kind: type, where: str) -> Any:
    """Return ``value`` as ``kind``: int, float, bool, str or an enum of strings.

    Raises :class:`UserError` for a value of another type.
    """
    if issubclass(kind, StrEnum):
        if value not in list(kind):
            known = ", ".join(repr(str(member)) for member in kind)
            raise UserError(f"{where}: {value!r} is none of {known}")
        return kind(value)
    if type(value) is int and abs(value) > MAX_INTEGER:
        raise UserError(f"{where}: an integer of more than 64 bits")
    if kind is float and type(value) is int:
        return float(value)
    # Not ``isinstance``: True is an int.
    if type(value) is not kind:
        raise UserError(f"{where}: expected {kind.__name__}, got {value!r}")
    return value


def decimal(text: str) -> float:
    """Return the number of a decimal text, as other programs read it. Raise ``ValueError``.

    Python's ``float`` also takes "1_0", digits of other scripts, and blanks and line breaks around
    the number.
    """
    if not DECIMAL.fullmatch(text):
        raise ValueError(f"{text!r} is not a decimal number")
    return float(text)


def whole(text: str) -> int:
    """Return the number of a text of ASCII digits. Raise ``ValueError``."""
    if not WHOLE.fullmatch(text):
        raise ValueError(f"{text!r} is not a whole number")
    return int(text)


def plain(value: Any) -> Any:
    """Return a number of NumPy or torch as Python's; anything else as it is."""
    return value.item() if getattr(value, "ndim", None) == 0 else value


@dataclass(frozen=True)
class Range:
    """Finite numbers from ``low`` to ``high``; ``bounds`` is "[]", "(]", "[)" or "()"."""

    low: float
    high: float = inf
    bounds: str = "[]"

    def __contains__(self, number: float) -> bool:
        above = number >= self.low if self.bounds[0] == "[" else number > self.low
        below = number <= self.high if self.bounds[1] == "]" else number < self.high
        return above and below and isfinite(number)

    def __str__(self) -> str:
        left = self.bounds[0]
        right = self.bounds[1]
        if self.high == inf:  # which is not in the range
            right = ")"
        return f"{left}{self.low:g}, {self.high:g}{right}"


AT_LEAST_0 = Range(0)
AT_LEAST_1 = Range(1)
POSITIVE = Range(0, bounds="(]")
SHARE = Range(0, 1)  # a fraction; also the range of scores


def check_ranges(config: Any, **ranges: Range) -> None:
    """Raise ``ValueError`` for the first attribute of ``config`` that is out of its range."""
    for name, allowed in ranges.items():
        number = getattr(config, name)
        if number not in allowed:
            raise ValueError(f"{name} must be in {allowed}, not {number}")
