"""COLMAP's files of a batch: where they go, what its images are called there, and which way up these are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.exif import exif_of_file
from mkpc_kaggle.geometry.coordinates import Points, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

DATABASE, MODELS = "database.db", "models"
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
FORMER = "former"  # models that are being replaced
PART = ".new-"  # how the names of folders begin in which files are made that replace former files


@dataclass(frozen=True)
class Export:
    """``database.db`` and ``models/`` in ``directory``, of images in ``source``.

    ``files`` has, by an image's name in the batch, the name of its file in ``source``, and by how many quarters,
    counter-clockwise, what was matched is turned from what the file shows the right way up.
    """

    directory: Path
    source: Path
    files: Mapping[str, tuple[str, int]]

    def has_files(self, models: int) -> bool:
        """Whether the files of a reconstruction with so many models are there."""
        folders = [self.directory / MODELS / str(number) for number in range(models)]
        return all(
            path.is_file()
            for path in (self.directory / DATABASE, *(each / name for each in folders for name in MODEL_FILES))
        )

    def stored(self, pairs: Sequence[BatchPair]) -> list[BatchPair]:
        """The pairs with their images under their files' names, and with points in pixels of what the files store.

        So COLMAP reads files, whatever EXIF says of their orientation. A mirrored file has no matches with others:
        no world would explain them.
        """
        images = {image.name: image for pair in pairs for image in (pair.image0, pair.image1)}
        files = {name: StoredImage.of(image, self.source, *self.files[name]) for name, image in images.items()}
        return [_stored(pair, files[pair.image0.name], files[pair.image1.name]) for pair in pairs]


@dataclass(frozen=True)
class StoredImage:
    """An image as its file stores it.

    What was matched is turned from it by so many quarters, perhaps mirrored first, and has the size ``shown``.
    """

    image: BatchImage
    shown: Size
    quarters: int
    is_mirrored: bool

    @classmethod
    def of(cls, image: BatchImage, source: Path, name: str, turns: int) -> "StoredImage":
        exif = exif_of_file(source / name, image.size)
        quarters = (exif.quarters + turns) % 4
        size = Size(*reversed(image.size)) if quarters % 2 else image.size
        return cls(BatchImage(name, image.digest, size, exif.focal), image.size, quarters, exif.is_mirrored)

    def points(self, shown: Points) -> Points:
        """(N, 2) points of what was shown, in pixels of the file."""
        points = turned_back(shown, self.quarters, self.shown)
        if self.is_mirrored:
            points = np.column_stack([self.image.size.width - 1 - points[:, 0], points[:, 1]])
        return points


def _stored(pair: BatchPair, first: StoredImage, second: StoredImage) -> BatchPair:
    def moved(found: Matches) -> Matches:
        if first.is_mirrored != second.is_mirrored:
            return Matches.empty()
        return Matches(first.points(found.points0), second.points(found.points1), found.scores)

    tracks = None if pair.tracks is None else moved(pair.tracks)
    return BatchPair(first.image, second.image, moved(pair.matches), None, tracks)


def turned_back(points: Points, times: int, size: Size) -> Points:
    """Points, (N, 2), of ``np.rot90(picture, times)``, which has this size, in pixels of the picture."""
    for turn in range(times):
        height = size[1 - turn % 2]
        points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
    return points
