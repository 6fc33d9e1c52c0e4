"""Points of a reconstruction from COLMAP's ``points3D.bin``, with colours, without pycolmap.

pycolmap may end the process, so a report does not import it. Source: COLMAP's description of its
binary format.
"""

import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.store.tables import SceneRecord
from mkpc_kaggle.scene.export import SPARSE
from mkpc_kaggle.scene.models import MAX_POINTS

COUNT = struct.Struct("<Q")
POINT = struct.Struct("<Q3d3BdQ")  # id, x, y, z, red, green, blue, error, length of the track
OBSERVATION_BYTES = 8  # of a track: image id and index of the keypoint


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (P, 3) float64 and colours (P, 3) uint8 of a model, the longest tracks first."""

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]


def clouds_of(scene: SceneRecord, out: Path) -> Sequence[Cloud]:
    """Return the points of a scene's models from the results of ``reconstruct`` in ``out``.

    Empty if no results exist, or if they belong to another run: then the number of points differs.
    """
    for folder in (out / scene.batch / SPARSE, out / SPARSE):
        with suppress(OSError, struct.error, ValueError):
            found = [read_cloud(folder / str(n) / "points3D.bin") for n in range(len(scene.models))]
            # A killed run may have left the files of an earlier scene.
            if sum(count for _, count in found) == scene.points:
                return [cloud for cloud, _ in found]
    return ()


def read_cloud(path: Path) -> tuple[Cloud, int]:
    """Return up to ``MAX_POINTS`` points of a file, and the number of all its points.

    Raises ``OSError`` if the file cannot be read, ``struct.error`` or ``ValueError`` if it is
    damaged.
    """
    data = path.read_bytes()
    (count,) = COUNT.unpack_from(data)
    if count * POINT.size > len(data):
        raise ValueError(f"{path} is cut off")
    rows = []
    at = COUNT.size
    # Rows have different lengths, so numpy cannot read them at once.
    for _ in range(count):
        rows.append(POINT.unpack_from(data, at))
        at += POINT.size + OBSERVATION_BYTES * rows[-1][-1]
    rows.sort(key=lambda row: -row[-1])
    kept = rows[:MAX_POINTS]
    points = np.array([row[1:4] for row in kept], np.float64).reshape(-1, 3)
    colours = np.array([row[4:7] for row in kept], np.uint8).reshape(-1, 3)
    # A point that bundle adjustment lost would spoil the extent of the view.
    finite = np.isfinite(points).all(axis=1)
    return Cloud(points[finite], colours[finite]), count
