"""Matches of pairs with known cameras, kept on disk: found once, read by every benchmark of what follows them.

A file for each pair, FOLDER/SCENE/IMAGE0-IMAGE1.npz: ``points0``, ``points1`` (N, 2) and ``scores`` (N,) in image
pixels; ``size0`` and ``size1``, width and height.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import TruePair
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch


@dataclass(frozen=True, eq=False)
class SavedMatches:
    """The matches of a pair, and the sizes of its images."""

    matches: Matches
    sizes: tuple[Size, Size]


def file_of(folder: Path, true: TruePair) -> Path:
    return folder / true.pair.group / f"{true.pair.image0.stem}-{true.pair.image1.stem}.npz"


def write(path: Path, pair: PairMatch) -> None:
    """Appears whole or not at all."""
    matches = pair.matches
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as stream:
        np.savez(
            stream,
            points0=matches.points0,
            points1=matches.points1,
            scores=matches.scores,
            size0=pair.images[0].size,
            size1=pair.images[1].size,
        )
    part.replace(path)


def read(path: Path) -> SavedMatches:
    with np.load(path) as kept:
        matches = Matches(kept["points0"], kept["points1"], kept["scores"])
        size0, size1 = (Size(*map(int, kept[name])) for name in ("size0", "size1"))
        return SavedMatches(matches, (size0, size1))
