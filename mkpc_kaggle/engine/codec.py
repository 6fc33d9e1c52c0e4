"""Points and matrices as bytes of the journal."""

import zlib

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches

MAX_POINT_BYTES = 1 << 26  # of a unit on a pair: three million matches; a damaged journal may promise more


def to_blob(matches: Matches) -> bytes:
    """Return all float32 values column by column, first bytes first: similar bytes deflate well."""
    table = np.column_stack([matches.points0, matches.points1, matches.scores])
    columns = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4)
    return zlib.compress(columns.T.tobytes(), level=1)


def from_blob(blob: bytes) -> Matches:
    """Invert :func:`to_blob`. Raise ``ValueError`` or ``zlib.error`` for damaged bytes."""
    stream = zlib.decompressobj()
    data = stream.decompress(blob, MAX_POINT_BYTES)
    if not stream.eof:
        raise ValueError("points are cut off or too many")
    planes = np.frombuffer(data, np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view(np.float32).reshape(5, -1)
    return Matches(table[:2].T, table[2:4].T, table[4])


def matrix_of(blob: bytes) -> Matrix3:
    """Return F from its 72 bytes. Raise ``ValueError`` unless a submission may hold it."""
    matrix = vector_of(blob).reshape(3, 3)
    if not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero or not finite")
    return matrix


def vector_of(blob: bytes) -> NDArray[np.float64]:
    return np.frombuffer(blob, np.float64).copy()
