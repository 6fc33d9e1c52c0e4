"""COLMAP's files of a batch."""

from dataclasses import dataclass
from pathlib import Path

DATABASE, MODELS = "database.db", "models"
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
FORMER = "former"  # folder of the models being replaced
PART = ".mkpc-new-"  # prefix of temporary folders, whose files replace former files


@dataclass(frozen=True)
class Export:
    """``database.db`` and ``models/`` in ``directory``."""

    directory: Path

    def has_files(self, models: int) -> bool:
        """Return whether the files of a reconstruction with that number of models exist."""
        folders = [self.directory / MODELS / str(number) for number in range(models)]
        return all(
            path.is_file()
            for path in (self.directory / DATABASE, *(each / name for each in folders for name in MODEL_FILES))
        )
