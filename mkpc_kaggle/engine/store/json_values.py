"""Dataclasses as JSON values, and back, by the types of their fields."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np


def as_json(value: Any) -> Any:
    """Return a value as JSON has it: a dataclass is an object with its fields, a tuple a list."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {name: as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, Enum) else value


def from_json(kind: Any, value: Any) -> Any:
    """Return the value of a type that :func:`as_json` made ``value`` from.

    A field that is missing gets its default. Arrays are of float64.
    """
    if get_origin(kind) is not None:
        return _of_generic(get_origin(kind), get_args(kind), value)
    if not isinstance(kind, type):
        return value
    if is_dataclass(kind):
        hints = _hints(kind)
        return kind(**{name: from_json(hints[name], item) for name, item in value.items()})
    if issubclass(kind, tuple):
        return kind(*value)  # a named tuple
    return kind(value) if issubclass(kind, Enum) else value


def _of_generic(origin: Any, kinds: tuple[Any, ...], value: Any) -> Any:
    if origin in (Union, UnionType):
        # ``None`` and the empty tuple stand for an unknown value.
        if value is None:
            return None
        if not value and tuple[()] in kinds:
            return ()
        (kind,) = set(kinds) - {NoneType, tuple[()]}
        return from_json(kind, value)
    if origin is np.ndarray:
        return np.array(value, float)
    if issubclass(origin, Mapping):
        return {name: from_json(kinds[1], item) for name, item in value.items()}
    items = (from_json(kinds[0], item) for item in value)
    return tuple(items) if origin is tuple else list(items)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)
