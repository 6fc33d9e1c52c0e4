"""COLMAP's files of a batch: where they go, what its images are called there, and which way up these are."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mkpc_kaggle.geometry.coordinates import Points, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

DATABASE, MODELS = "database.db", "models"


@dataclass(frozen=True)
class Export:
    """``database.db`` and ``models/`` in ``directory``.

    ``files`` has, by an image's name in the batch, the name of its file, and by how many quarters,
    counter-clockwise, what was matched is turned from that file.
    """

    directory: Path
    files: Mapping[str, tuple[str, int]]

    def original(self, pair: BatchPair) -> BatchPair:
        """The pair with its images under their files' names, and its points in these files' pixels."""
        names, turns = zip(*(self.files[image.name] for image in (pair.image0, pair.image1)), strict=True)
        sizes = pair.image0.size, pair.image1.size

        def upright(matches: Matches) -> Matches:
            points0, points1 = (
                turned_back(*each) for each in zip((matches.points0, matches.points1), turns, sizes, strict=True)
            )
            return Matches(points0, points1, matches.scores)

        image0, image1 = (
            BatchImage(name, image.digest, Size(*image.size[:: -1 if times % 2 else 1]))
            for name, times, image in zip(names, turns, (pair.image0, pair.image1), strict=True)
        )
        tracks = pair.tracks and {name: upright(found) for name, found in pair.tracks.items()}
        own = None if any(turns) else pair.pair_fundamental
        return BatchPair(image0, image1, upright(pair.matches), own, tracks)

    def stage(self) -> Path:
        """A new folder beside the files, to write them in."""
        stage = self.directory / ".colmap"
        shutil.rmtree(stage, ignore_errors=True)
        stage.mkdir(parents=True)
        return stage

    def install(self, made: Path) -> None:
        """Put the files of a folder in the :meth:`stage` into the place of earlier ones."""
        shutil.rmtree(self.directory / MODELS, ignore_errors=True)
        for name in (DATABASE, MODELS):
            if (made / name).exists():
                (made / name).replace(self.directory / name)
        shutil.rmtree(self.directory / ".colmap")


def turned_back(points: Points, times: int, size: Size) -> Points:
    """Points, (N, 2), of ``np.rot90(picture, times)``, which has this size, in pixels of the picture."""
    width, height = size
    for _ in range(times):
        points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
        width, height = height, width
    return points
