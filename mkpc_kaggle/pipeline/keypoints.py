"""Keypoints of a match, for programs: positions, descriptors, and which of them matched."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Points, View
from mkpc_kaggle.geometry.matches import Matches

UNKNOWN = -1  # the index of a match by a matcher without keypoints


@dataclass(frozen=True, eq=False)
class PairKeypoints:
    """Keypoints of both images, in image pixels.

    ``points0`` is (K0, 2) and ``points1`` (K1, 2). Row n of ``indices`` (N, 2) has the rows of both
    points of match n, or -1 for a matcher without keypoints. Descriptors, (K0, D) and (K1, D), are
    ``None`` unless they were asked for, and if units have descriptors of different lengths; each
    unit's are in ``match.results``.
    """

    points0: Points
    points1: Points
    indices: NDArray[np.int64]
    descriptors0: NDArray[np.float32] | None = None
    descriptors1: NDArray[np.float32] | None = None

    @classmethod
    def of(
        cls,
        encodings: tuple[Any, Any],
        views: tuple[View, ...],
        matches: Matches,
        *,
        with_descriptors: bool,
    ) -> "PairKeypoints | None":
        """Return the keypoints of two encodings; ``None`` if a matcher has none, or no indices."""
        if matches.indices is None or not all(hasattr(each, "points") for each in encodings):
            return None
        points = []
        descriptors: list[NDArray[np.float32] | None] = []
        for encoding, view in zip(encodings, views, strict=True):
            points.append(view.to_image(_array(encoding.points)).astype(np.float32))
            own = getattr(encoding, "descriptors", None) if with_descriptors else None
            descriptors.append(None if own is None else np.asarray(_array(own), np.float32))
        return cls(points[0], points[1], matches.indices, descriptors[0], descriptors[1])

    @classmethod
    def concatenate(
        cls, parts: Sequence["PairKeypoints | None"], counts: Sequence[int]
    ) -> "PairKeypoints":
        """Return the keypoints of all units one after another; ``counts`` of their matches."""
        points0 = [np.zeros((0, 2), np.float32)]
        points1 = [np.zeros((0, 2), np.float32)]
        indices = [np.zeros((0, 2), np.int64)]
        first = second = 0
        for part, count in zip(parts, counts, strict=True):
            if part is None:
                indices.append(np.full((count, 2), UNKNOWN))
                continue
            points0.append(part.points0)
            points1.append(part.points1)
            indices.append(part.indices + np.array([first, second]))
            first += len(part.points0)
            second += len(part.points1)
        own = [part for part in parts if part is not None]
        return cls(
            np.concatenate(points0),
            np.concatenate(points1),
            np.concatenate(indices),
            _stacked([part.descriptors0 for part in own]),
            _stacked([part.descriptors1 for part in own]),
        )


def _stacked(parts: Sequence[NDArray[np.float32] | None]) -> NDArray[np.float32] | None:
    """Return all descriptors in order; ``None`` if some are missing or of another length."""
    known = [part for part in parts if part is not None]
    if not known or len(known) < len(parts) or len({part.shape[1] for part in known}) > 1:
        return None
    return np.concatenate(known)


def _array(values: Any) -> NDArray[Any]:
    """Return an array or a tensor of any device as an array."""
    return np.asarray(values.cpu().numpy() if hasattr(values, "cpu") else values)
