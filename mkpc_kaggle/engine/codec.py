"""Values in the journal: dataclasses as JSON, checked against their types when read, and points as bytes."""

import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import astuple, is_dataclass
from enum import StrEnum
from functools import cache, partial
from math import isfinite
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from mkpc_kaggle.data.images import printable
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches

MAX_POINT_BYTES = 1 << 26  # of a unit on a pair: three million matches; a damaged journal may promise more


def encode(value: Any) -> str:
    """The JSON text of a value: the fields of a dataclass in their order, matrices row by row.

    Raises ``ValueError`` for numbers that are not finite: a journal that has them could not be read again.
    """
    values = astuple(value) if is_dataclass(value) and not isinstance(value, type) else value
    return json.dumps(values, default=lambda array: array.tolist(), allow_nan=False)


@cache
def decoder(kind: Any) -> Callable[[Any], Any]:
    """A function that makes a value of the type ``kind`` of its JSON, and raises where it is of another type."""
    if isinstance(kind, type) and issubclass(kind, (int, float, str)):
        return partial(scalar, kind)
    if kind == Matrix3:  # since NumPy 2.5 the origin of NDArray[float64] is an alias, not np.ndarray
        return matrix_of
    origin, arguments = get_origin(kind), get_args(kind)
    hints = arguments or get_type_hints(kind).values()
    parts = [decoder(hint) for hint in hints if hint not in (NoneType, ...)]
    if origin is UnionType:  # with None
        return lambda value: None if value is None else parts[0](value)
    if origin is Mapping:
        return lambda table: {parts[0](key): parts[1](value) for key, value in table.items()}
    if ... in arguments:
        return lambda values: tuple(map(parts[0], values))
    make = (lambda *values: values) if origin is tuple else kind
    return lambda values: make(*(part(value) for part, value in zip(parts, values, strict=True)))


def scalar(kind: type, value: Any) -> Any:
    """A number, a text or a member of an enum."""
    if issubclass(kind, StrEnum):
        return kind(value)
    if kind is float and type(value) in (int, float) and isfinite(value):
        return float(value)
    if kind is float or type(value) is not kind:
        raise ValueError(f"{value!r} is not of type {kind.__name__}")
    return printable(value) if isinstance(value, str) else value


def matrix_of(rows: Any) -> Matrix3:
    """F from its rows; ``ValueError`` where a submission may not have it."""
    matrix = np.array(rows, np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero, not finite, or not of 3 x 3 numbers")
    return matrix


def to_blob(matches: Matches) -> bytes:
    """All float32 values, column by column, first bytes first: those of like size are alike, and deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def from_blob(blob: bytes | None) -> Matches:
    if blob is None:
        return Matches.empty()
    stream = zlib.decompressobj()
    data = stream.decompress(blob, MAX_POINT_BYTES)
    if not stream.eof:
        raise ValueError("points are cut off, or more than there can be")
    planes = np.frombuffer(data, np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])
