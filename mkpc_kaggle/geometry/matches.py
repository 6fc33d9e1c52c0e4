"""Corresponding points of a pair; outside matchers, in image pixels. Zero matches are legal."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Points, View

MEANINGS = {
    "points0": "shape (N, 2)",
    "points1": "shape (N, 2)",
    "scores": "shape (N,)",
}


@dataclass(frozen=True, eq=False)
class Matches:
    """N corresponding points (x, y) with scores; pixel centres are at integers.

    All methods keep the matcher's order, since MAGSAC's result depends on it.

    Parameters
    ----------
    points0, points1 : array (N, 2) of float32
        The points in image 0 and image 1. Lists, tensors and other dtypes are converted.
    scores : array (N,) of float32
        A higher score is more certain.

    Raises
    ------
    ValueError
        If the shapes do not agree.
    TypeError
        If points or scores are ``None``.

    Examples
    --------
    >>> from mkpc_kaggle import Matches
    >>> matches = Matches([[10, 20], [30, 40]], [[12, 20], [33, 41]], [0.9, 0.4])
    >>> len(matches), len(matches[matches.scores > 0.5])
    (2, 1)
    >>> len(Matches.empty())
    0
    """

    points0: Points
    points1: Points
    scores: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name, width in (("scores", ()), ("points0", (2,)), ("points1", (2,))):
            given = getattr(self, name)
            if given is None:
                raise TypeError(f"{name} is None; expected an array of {MEANINGS[name]}")
            # Of a tensor with a gradient, or on a GPU, NumPy takes no array.
            if hasattr(given, "detach"):
                given = given.detach().cpu()
            array = np.ascontiguousarray(given, dtype=np.float32)
            if array.shape == (0,):  # an empty list is an empty list of points
                array = array.reshape(0, *width)
            if array.shape != (len(self.scores), *width):
                raise ValueError(
                    f"{name} has shape {array.shape}; expected {MEANINGS[name]}, N = {len(self.scores)}"
                )
            object.__setattr__(self, name, array)  # the class is frozen

    @classmethod
    def empty(cls) -> "Matches":
        points = np.zeros((0, 2), np.float32)
        return cls(points, points, np.zeros(0, np.float32))

    @classmethod
    def from_bytes(cls, data: bytes) -> "Matches":
        """Invert :meth:`to_bytes`."""
        table = np.frombuffer(data, "<f4").reshape(-1, 5)
        return cls(table[:, :2], table[:, 2:4], table[:, 4])

    def to_bytes(self) -> bytes:
        """Return the bytes of x0, y0, x1, y1 and score of each match, as little-endian float32."""
        columns = [self.points0, self.points1, self.scores]
        return np.column_stack(columns).astype("<f4").tobytes()

    @classmethod
    def concatenate(cls, parts: Iterable["Matches"]) -> "Matches":
        """Return all parts in order, without merging or sorting."""
        parts = list(parts)
        if not parts:
            return cls.empty()
        return cls(
            np.concatenate([part.points0 for part in parts]),
            np.concatenate([part.points1 for part in parts]),
            np.concatenate([part.scores for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(
        self, index: NDArray[np.bool_] | NDArray[np.integer] | slice
    ) -> "Matches":
        """Return the matches selected by a mask, indices or a slice."""
        return Matches(self.points0[index], self.points1[index], self.scores[index])

    def best(self, most: int) -> "Matches":
        """Return up to ``most`` matches of highest score, in their present order.

        Of equal scores, the earlier ones.
        """
        if len(self) <= most:
            return self
        chosen = np.argsort(-self.scores, kind="stable")[:most]
        return self[np.sort(chosen)]  # back in the present order

    def to_image(self, view0: View, view1: View) -> "Matches":
        """Convert matches in view pixels to image pixels.

        Drops matches with a non-finite point or score, and matches with a point outside its view's
        content.
        """
        on_content = view0.holds(self.points0) & view1.holds(self.points1)
        kept = self[on_content & np.isfinite(self.scores)]
        # Converted in float64: in float32, large images would lose digits at each step.
        return Matches(
            view0.to_image(kept.points0).astype(np.float32),
            view1.to_image(kept.points1).astype(np.float32),
            kept.scores,
        )
