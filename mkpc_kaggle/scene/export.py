"""The files that COLMAP reads, of one batch, in a directory that may also have files of others."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.scene.whole_files import is_whole_database, is_whole_model_file

DATABASE, MODELS = "database.db", "models"
IMAGES, SPARSE = "images", "sparse"  # as other programs expect them
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
FORMER = "former"  # folder of the models being replaced
PART = ".mkpc-new-"  # prefix of temporary folders for new files
# The paths of our files in a folder of models
MODEL_FILE = re.compile(rf"\d+/({'|'.join(map(re.escape, MODEL_FILES))})")


@dataclass(frozen=True)
class HeldDirectory:
    """A directory of results with its identity, since its path may lead elsewhere later in a run.

    Nothing may be written or removed below the path if it is another directory: that is the user's.
    """

    path: Path
    device: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> "HeldDirectory":
        """Hold a directory, which is created if missing."""
        path.mkdir(parents=True, exist_ok=True)
        status = path.stat()
        return cls(path, status.st_dev, status.st_ino)

    @property
    def is_here(self) -> bool:
        """Whether the path still leads to the directory."""
        try:
            status = self.path.stat()
        except OSError:
            return False
        return (status.st_dev, status.st_ino) == (self.device, self.inode)

    def check(self) -> None:
        """Raise ``OSError`` if the path leads to another directory, or to none."""
        if not self.is_here:
            text = "the directory was moved or replaced during the run"
            raise OSError(errno.ESTALE, text, str(self.path))


def has_files(directory: Path, models: int) -> bool:
    """Return whether ``directory`` has the files of a reconstruction with ``models`` models, none of
    them cut off.
    """
    names = [f"{MODELS}/{number}/{name}" for number in range(models) for name in MODEL_FILES]
    is_whole = is_whole_database(directory / DATABASE)
    return is_whole and all(is_whole_model_file(directory / name) for name in names)


def require_on_disk(made: Path) -> None:
    """Wait until the files below a folder are on the disk. Raise ``OSError`` if one of COLMAP's is cut
    off.

    A power failure must not leave empty files under their names. pycolmap reports no full disk.
    """
    for path in filter(Path.is_file, made.rglob("*")):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        # SQLite reports a full disk itself.
        if path.name in MODEL_FILES and not is_whole_model_file(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path.name)


def model_files(folder: Path) -> Iterator[Path]:
    """Yield our files in a folder of models; links and files of other names are not ours."""
    for path in folder.rglob("*"):
        is_ours = MODEL_FILE.fullmatch(path.relative_to(folder).as_posix())
        if is_ours and path.is_file() and not path.is_symlink():
            yield path


def versions_of(directory: Path) -> dict[Path, tuple[int, int, int]]:
    """Return inode, size and time of change of our files of a batch, by path."""
    paths = [*model_files(directory / MODELS), *model_files(directory / SPARSE)]
    database = directory / DATABASE
    if database.is_file() and not database.is_symlink():
        paths.append(database)
    found = {}
    for path in paths:
        status = path.stat()
        found[path] = (status.st_ino, status.st_size, status.st_mtime_ns)
    return found


def remove_files(held: HeldDirectory, former: dict[Path, tuple[int, int, int]]) -> bool:
    """Remove the files of a batch that are as in ``former``, of :func:`versions_of`. Return whether
    there were any.

    Files that have appeared or changed since, and files of others, stay.
    """
    if not held.is_here:
        return False
    now = versions_of(held.path)
    removed = [path for path, version in former.items() if now.get(path) == version]
    for path in removed:
        path.unlink()
    for name in (MODELS, SPARSE):
        remove_empty(held.path / name)
    return bool(removed)


def remove_models(folder: Path) -> None:
    """Remove our files in a folder of models, and the folders that are empty then."""
    for path in model_files(folder):
        path.unlink()
    remove_empty(folder)


def remove_empty(folder: Path) -> None:
    """Remove a folder and the folders in it that are empty."""
    folders = [path for path in folder.rglob("*") if path.is_dir() and not path.is_symlink()]
    # The innermost first
    for path in [*sorted(folders, key=lambda path: -len(path.parts)), folder]:
        with suppress(OSError):  # not empty, or missing
            path.rmdir()


def replace_models(made: Path, folder: Path, former: Path) -> None:
    """Replace a folder of models by ``made``. The former folder is removed, by way of the unused
    path ``former``.

    Files of others move over to the new folder, where they keep their paths.
    """
    # Before the renames: a kill between them must not lose a file of others.
    _link_files_of_others(folder, made)
    if folder.exists():
        folder.rename(former)
    # Without models there is no folder, which other programs would take for an empty model.
    if made.exists() and any(made.iterdir()):
        made.rename(folder)
    # Files that have appeared meanwhile
    _link_files_of_others(former, folder)
    shutil.rmtree(former, ignore_errors=True)


def _link_files_of_others(folder: Path, target: Path) -> None:
    """Give the files of others the same paths in another folder, by links, or by copies where links
    fail.
    """
    ours = set(model_files(folder))
    for path in folder.rglob("*"):
        if path in ours or (path.is_dir() and not path.is_symlink()):
            continue
        other = target / path.relative_to(folder)
        if os.path.lexists(other):
            continue
        other.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, other, follow_symlinks=False)
        except OSError:  # a file system without links
            shutil.copy2(path, other, follow_symlinks=False)


def remove_parts(directory: Path) -> None:
    """Remove our files in the temporary folders of a killed process."""
    for left in directory.glob(f"{PART}*"):
        if left.is_dir() and not left.is_symlink():
            for name in (MODELS, SPARSE, FORMER):
                remove_models(left / name)
            # Undistorted photographs
            if not (left / IMAGES).is_symlink():
                shutil.rmtree(left / IMAGES, ignore_errors=True)
            # A process that is killed while it writes the database leaves SQLite's other files.
            for ending in ("", "-journal", "-wal", "-shm"):
                (left / f"{DATABASE}{ending}").unlink(missing_ok=True)
            remove_empty(left)
