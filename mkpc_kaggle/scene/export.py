"""COLMAP's files of a batch: where they go, what its images are called there, and which way up these are."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mkpc_kaggle.geometry.coordinates import Points, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

DATABASE, MODELS = "database.db", "models"
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
FORMER = "former"  # models that are being replaced
PART = ".new-"  # how the names of folders begin in which files are made that replace former files


@dataclass(frozen=True)
class Export:
    """``database.db`` and ``models/`` in ``directory``.

    ``files`` has, by an image's name in the batch, the name of its file, and by how many quarters,
    counter-clockwise, what was matched is turned from that file.
    """

    directory: Path
    files: Mapping[str, tuple[str, int]]

    def has_files(self, models: int) -> bool:
        """Whether the files of a reconstruction with so many models are there."""
        folders = [self.directory / MODELS / str(number) for number in range(models)]
        return all(
            path.is_file()
            for path in (self.directory / DATABASE, *(each / name for each in folders for name in MODEL_FILES))
        )

    def original(self, pair: BatchPair) -> BatchPair:
        """The pair with its images under their files' names, and its points in these files' pixels."""
        (image0, turns0), (image1, turns1) = (self._file(image) for image in (pair.image0, pair.image1))

        def upright(found: Matches) -> Matches:
            points0 = turned_back(found.points0, turns0, pair.image0.size)
            return Matches(points0, turned_back(found.points1, turns1, pair.image1.size), found.scores)

        tracks = pair.tracks and {name: upright(found) for name, found in pair.tracks.items()}
        return BatchPair(image0, image1, upright(pair.matches), None, tracks)

    def _file(self, image: BatchImage) -> tuple[BatchImage, int]:
        name, turns = self.files[image.name]
        width, height = image.size
        return BatchImage(name, image.digest, Size(height, width) if turns % 2 else image.size), turns


def turned_back(points: Points, times: int, size: Size) -> Points:
    """Points, (N, 2), of ``np.rot90(picture, times)``, which has this size, in pixels of the picture."""
    for turn in range(times):
        height = size[1 - turn % 2]
        points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
    return points
