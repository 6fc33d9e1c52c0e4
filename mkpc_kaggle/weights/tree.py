"""A directory that is searched for weights: its files by name, and candidates under other names."""

import os
import stat
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from mkpc_kaggle.weights.notices import warn_once
from mkpc_kaggle.weights.unpacked import is_unpacked, names_of

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png"})
CHECKPOINT_SUFFIXES = frozenset({".pth", ".pt", ".ckpt", ".safetensors", ".bin", ".pkl", ""})
LARGEST_OF_UNKNOWN_SIZE = 1 << 28
"""Bytes. The files whose size is not known have some 50 MB; larger ones need not be read."""


class Tree:
    """A directory and all below it, walked once, on first use.

    Links are followed, since Kaggle mounts inputs by links; no directory is entered twice, so that cycles
    end. What cannot be read is skipped with a warning.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def named(self, name: str) -> Iterator[Path]:
        """Files of this name: first in the directory itself, since a walk of /kaggle/input costs seconds."""
        direct = self.root / name
        if _is_entry(direct):
            yield direct
        yield from (path for path in self._by_name.get(name, ()) if path != direct)

    def candidates(self, size: int) -> Iterator[Path]:
        """Files that may be one of ``size`` bytes under another name; where that is -1, small checkpoints."""
        for path, its_size in self._sizes.items():
            likely = path.suffix.lower() in CHECKPOINT_SUFFIXES and its_size <= LARGEST_OF_UNKNOWN_SIZE
            if its_size == size or (size < 0 and likely):
                yield path

    def unpacked_named(self, name: str) -> Iterator[Path]:
        """Directories into which a checkpoint of this name was unpacked."""
        return (path for path in self.unpacked if names_of(path) & {name, Path(name).stem})

    @property
    def files(self) -> tuple[Path, ...]:
        """All files by path, without images, of which a competition's input has thousands."""
        return self._walked[0]

    @property
    def unpacked(self) -> tuple[Path, ...]:
        """The directories with the contents of a torch checkpoint; their files are not among ``files``."""
        return self._walked[1]

    @cached_property
    def _walked(self) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
        found: list[Path] = []
        unpacked: list[Path] = []
        entered: set[tuple[int, int]] = set()
        for folder, folders, names in os.walk(self.root, onerror=_warn_unreadable, followlinks=True):
            status = Path(folder).stat()
            again, checkpoint = (status.st_dev, status.st_ino) in entered, is_unpacked(folders, names)
            entered.add((status.st_dev, status.st_ino))
            if again or checkpoint:
                folders.clear()  # os.walk goes no deeper
            if checkpoint and not again:
                unpacked.append(Path(folder))
            elif not again:
                found += [Path(folder, name) for name in names if Path(name).suffix.lower() not in IMAGE_SUFFIXES]
        return tuple(sorted(found)), tuple(sorted(unpacked))

    @cached_property
    def _by_name(self) -> dict[str, list[Path]]:
        named: dict[str, list[Path]] = {}
        for path in self.files:
            named.setdefault(path.name, []).append(path)
        return named

    @cached_property
    def _sizes(self) -> dict[Path, int]:
        """Bytes of each regular file."""
        sizes = {}
        for path in self.files:
            try:
                status = path.stat()
            except OSError as error:
                _warn_unreadable(error)
                continue
            if stat.S_ISREG(status.st_mode):
                sizes[path] = status.st_size
        return sizes


def _is_entry(path: Path) -> bool:
    """Whether there is anything but a directory; broken links count, so that they are reported."""
    try:
        path.lstat()
        return not path.is_dir()
    except OSError:
        return False


def _warn_unreadable(error: OSError) -> None:
    warn_once(f"{error.filename} cannot be read, so it is not searched for weights: {error.strerror}")
