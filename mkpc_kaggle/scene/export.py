"""The files that COLMAP reads, of one batch."""

import shutil
from pathlib import Path

DATABASE, MODELS = "database.db", "models"
IMAGES, SPARSE = "images", "sparse"  # as other programs expect them
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
FORMER = "former"  # folder of the models being replaced
PART = ".mkpc-new-"  # prefix of temporary folders for new files


def has_files(directory: Path, models: int) -> bool:
    """Return whether ``directory`` has the files of a reconstruction with ``models`` models."""
    names = [f"{MODELS}/{number}/{name}" for number in range(models) for name in MODEL_FILES]
    return all(directory.joinpath(name).is_file() for name in (DATABASE, *names))


def remove_files(directory: Path) -> bool:
    """Remove the files of a reconstruction. Return whether there were any."""
    found = [directory / name for name in (DATABASE, MODELS, SPARSE)]
    found = [path for path in found if path.exists()]
    for path in found:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    return bool(found)
