"""The keypoints and matches of all datasets of a folder in one file for hloc."""

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.hloc import HlocPair, write_hloc
from mkpc_kaggle.errors import plural, writing
from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX, Points, Size
from mkpc_kaggle.scene.export import DATABASE

PAIR_BASE = 2**31 - 1  # COLMAP's id of a pair is id0 * PAIR_BASE + id1


def export_matches(path: Path, out: Path, datasets: Iterable[str]) -> str:
    """Write what COLMAP's databases below ``out`` have to ``path``. Return a line about it.

    Images have their names in the databases. Raises :class:`UserError` if writing fails.
    """
    keypoints: dict[str, Points] = {}
    sizes: dict[str, Size] = {}
    pairs: list[HlocPair] = []
    for dataset in datasets:
        database = out / dataset / DATABASE
        # A dataset without matches has none.
        if database.is_file():
            _read(database, keypoints, sizes, pairs)
    with writing(f"--export {path}"):
        write_hloc(path, keypoints, sizes, pairs)
    images = plural(len(keypoints), "image")
    return f"{path}: keypoints of {images}, matches of {plural(len(pairs), 'pair')}"


def _read(
    file: Path, keypoints: dict[str, Points], sizes: dict[str, Size], pairs: list[HlocPair]
) -> None:
    """Add the contents of a database."""
    with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as database:
        names = {}
        images = "SELECT image_id, name, width, height FROM images JOIN cameras USING (camera_id)"
        for image, name, width, height in database.execute(images):
            names[image] = name
            sizes[name] = Size(width, height)
        points = "SELECT image_id, rows, cols, data FROM keypoints"
        for image, rows, columns, data in database.execute(points):
            # The first two columns are x and y.
            table = np.frombuffer(data or b"", np.float32).reshape(rows, columns)[:, :2]
            keypoints[names[image]] = np.asarray(table - COLMAP_CENTRE_PX, np.float32)
        matches = "SELECT pair_id, rows, cols, data FROM matches WHERE rows > 0"
        for pair, rows, columns, data in database.execute(matches):
            first, second = divmod(pair, PAIR_BASE)
            indices = np.frombuffer(data, np.uint32).reshape(rows, columns).astype(np.int64)
            pairs.append(HlocPair(names[first], names[second], indices, np.ones(rows, np.float32)))
