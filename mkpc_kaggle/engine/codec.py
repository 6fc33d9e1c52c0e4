"""Points and matrices as bytes of the journal."""

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches


def to_blob(matches: Matches) -> bytes:
    """Return x0, y0, x1, y1 and the score of each match, as little-endian float32."""
    return np.column_stack([matches.points0, matches.points1, matches.scores]).astype("<f4").tobytes()


def from_blob(blob: bytes) -> Matches:
    """Invert :func:`to_blob`. Raise ``ValueError`` for damaged bytes."""
    table = np.frombuffer(blob, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])


def matrix_of(blob: bytes) -> Matrix3:
    """Return F from its 72 bytes. Raise ``ValueError`` unless a submission may hold it."""
    matrix = vector_of(blob).reshape(3, 3)
    if not np.isfinite(matrix).all() or not matrix.any():
        raise ValueError("a matrix is zero or not finite")
    return matrix


def vector_of(blob: bytes) -> NDArray[np.float64]:
    return np.frombuffer(blob, np.float64).copy()
