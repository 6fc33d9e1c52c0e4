"""The names of COLMAP's files and folders of a batch, and files that are on the disk."""

import os
from pathlib import Path
from tempfile import TemporaryFile

DATABASE, MODELS = "database.db", "models"
IMAGES, SPARSE = "images", "sparse"  # as other programs expect them
PART = ".mkpc-new-"  # prefix of temporary folders for new files
PROBE_BYTES = 1 << 20  # more than the buffer of a stream that pycolmap writes


def sync(folder: Path) -> None:
    """Wait until the files below a folder are on the disk. Raise ``OSError`` if the disk is full.

    A power failure must not leave empty files under their names.
    """
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
    # pycolmap reports no full disk, so a file of ours must fit after its files.
    with TemporaryFile(dir=folder) as probe:
        probe.write(bytes(PROBE_BYTES))
        probe.flush()
        os.fsync(probe.fileno())
