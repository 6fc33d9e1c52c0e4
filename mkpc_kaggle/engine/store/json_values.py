"""Dataclasses as JSON, and back, by the types of their fields."""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

JsonReader = Callable[[Any], Any]


def to_text(value: Any) -> str:
    """Return a value as JSON: a dataclass is an object with its fields, a tuple a list. Raise
    ``ValueError`` for a number that is not finite.
    """
    return json.dumps(value, default=_of_known_type, allow_nan=False)


def _of_known_type(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return {field.name: getattr(value, field.name) for field in fields(value)}


@cache
def json_reader_of(kind: Any) -> JsonReader | None:
    """Return the function that makes a value of a type from the JSON value that :func:`to_text`
    wrote; ``None`` if that is the value.

    A field that is missing gets its default. Arrays are of float64.
    """
    kind = without_alias(kind)
    if get_origin(kind) is not None:
        return _reader_of_generic(get_origin(kind), get_args(kind))
    if not isinstance(kind, type):
        return None
    if is_dataclass(kind):
        return _reader_of_fields(kind)
    if issubclass(kind, tuple):
        return lambda value: kind(*value)  # a named tuple
    return kind if issubclass(kind, Enum) else None


def without_alias(kind: Any) -> Any:
    """Return the type that an alias of a ``type`` statement stands for; another type as it is."""
    # Since NumPy 2.5, NDArray is an alias of this kind.
    kinds = get_args(kind)
    value = getattr(get_origin(kind) or kind, "__value__", None)
    if value is None:
        return kind
    return without_alias(value[kinds] if kinds else value)


def _reader_of_fields(kind: Any) -> JsonReader:
    readers = {name: json_reader_of(hint) for name, hint in get_type_hints(kind).items()}

    def read(value: Any) -> Any:
        items = dict(value)
        for name in value:
            if (reader := readers[name]) is not None:
                items[name] = reader(items[name])
        return kind(**items)

    return read


def _reader_of_generic(origin: Any, kinds: tuple[Any, ...]) -> JsonReader | None:
    if origin in (Union, UnionType):
        return _reader_of_optional(kinds)
    if origin is np.ndarray:
        return lambda value: np.array(value, float)
    if issubclass(origin, Mapping):
        return _reader_of_mapping(json_reader_of(kinds[1]))
    item = json_reader_of(kinds[0])
    if item is None:
        return tuple if origin is tuple else None
    return lambda value: tuple(map(item, value))


def _reader_of_mapping(item: JsonReader | None) -> JsonReader | None:
    if item is None:
        return None
    return lambda value: {name: item(each) for name, each in value.items()}


def _reader_of_optional(kinds: tuple[Any, ...]) -> JsonReader:
    # ``None`` and the empty tuple stand for an unknown value.
    (kind,) = set(kinds) - {NoneType, tuple[()]}
    reader = json_reader_of(kind)

    def read(value: Any) -> Any:
        if value is None or reader is None:
            return value
        return () if not value and tuple[()] in kinds else reader(value)

    return read
