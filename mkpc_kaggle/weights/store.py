"""The weight files of this machine, found by name and compared with the manifest.

The file of a slot is the one that the user gives for it in Python, with any bytes. Else it is the first
good one of the names that the manifest has for the slot. Directories are searched in the order ``--weights``,
``$MKPC_WEIGHTS``, /kaggle/input, shallow files first. A file with another digest than the manifest's is passed
over; a file for which the manifest has no digest is used.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from mkpc_kaggle.data.outputs import weights_of_environment
from mkpc_kaggle.errors import UserError, warn_once
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.manifest import (
    MANIFEST,
    WeightFile,
    digest_of,
    manifest,
    read_manifest,
)

if TYPE_CHECKING:
    import torch

KAGGLE_INPUT = Path("/kaggle/input")
# A competition's input has thousands of images.
NOT_WEIGHTS = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class FoundFile:
    """A file with a name of the manifest."""

    file: WeightFile
    path: Path
    sha256: str  # of its bytes; empty if they were not read
    fault: str = ""  # why it is refused

    @property
    def is_verified(self) -> bool:
        return self.sha256 == self.file.sha256


class WeightStore:
    """Weight files in the search directories.

    Files are compared with ``files``. By default, these are the package's manifest and manifests in
    the search directories, which list weights that ``package`` converted. The files ``chosen`` for
    slots are used as they are.
    """

    def __init__(
        self,
        directories: Iterable[Path] = (),
        files: Sequence[WeightFile] | None = None,
        chosen: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        given = list(directories)
        for directory in given:
            if not directory.is_dir():
                raise UserError(f"--weights {directory}: no such directory")
        self.directories = [*given, *weights_of_environment(), KAGGLE_INPUT]
        self._given_files = files
        # By slot, ``None`` for a missing one. Sent to workers, which search and digest nothing.
        self._found: dict[str, FoundFile | None] = {}
        for slot, path in chosen.items():
            self._found[slot] = self._given(slot, path)

    @cached_property
    def files(self) -> tuple[WeightFile, ...]:
        """The files to compare with, one per name; the package's manifest comes first."""
        if self._given_files is not None:
            return tuple(self._given_files)
        files = {file.name: file for file in manifest()}
        for path in self._by_name.get(MANIFEST, ()):
            try:
                for file in read_manifest(path):
                    files.setdefault(file.name, file)
            except UserError as error:
                warn_once(f"passed over: {error}")
        return tuple(files.values())

    def _given(self, slot: str, path: Path) -> FoundFile:
        """Return the file that the user gives for a slot.

        Raises :class:`UserError` for an unknown slot and an unreadable file.
        """
        if not self.alternatives(slot):
            known = ", ".join(dict.fromkeys(file.slot for file in self.files))
            raise UserError(f"weights: unknown slot {slot!r}; known: {known}")
        try:
            digest = digest_of(path)
        except OSError as error:
            raise UserError(f"weights[{slot!r}]: {path}: {error.strerror}") from error
        return FoundFile(WeightFile(slot, "", sha256=digest, name=path.name), path, digest)

    def alternatives(self, slot: str) -> list[WeightFile]:
        """Return the manifest's files for a slot, in order of preference."""
        return [file for file in self.files if file.slot == slot]

    def file_of(self, slot: str) -> FoundFile | None:
        """Return the slot's file or ``None``. Warn of refused files of the right name."""
        if slot not in self._found:
            self._found[slot] = None
            for found in self.search(self.alternatives(slot)):
                if not found.fault:
                    self._found[slot] = found
                    break
                warn_once(f"passed over: {found.path}: {found.fault}")
        return self._found[slot]

    def load(self, slot: str) -> "dict[str, torch.Tensor]":
        """Return the slot's tensors by name. Raise :class:`UserError` for a missing or bad file."""
        found = self.file_of(slot)
        if found is None:
            names = " or ".join(file.name for file in self.alternatives(slot))
            raise UserError(
                f"no weights for {slot}: {names} not found; `mkpc weights fetch {slot} --out DIR` gets them"
            )
        return load_tensors(found.path)

    def search(self, files: Iterable[WeightFile]) -> Iterator[FoundFile]:
        """Yield the files with these names, and whether their bytes are the manifest's."""
        for file in files:
            for path in self._by_name.get(file.name, ()):
                yield compare(path, file)

    @cached_property
    def _by_name(self) -> dict[str, list[Path]]:
        """The paths of each name, in the order of the directories.

        Links are followed, since Kaggle mounts inputs by links. No directory is visited twice, so
        cycles end.
        """
        found = defaultdict(list)
        entered: set[str] = set()
        for root in self.directories:
            paths = []
            for folder, folders, names in os.walk(root, followlinks=True):
                real = os.path.realpath(folder)
                if real in entered:
                    folders.clear()  # os.walk skips the subfolders
                    continue
                entered.add(real)
                kept = [name for name in names if not name.lower().endswith(NOT_WEIGHTS)]
                paths += [Path(folder, name) for name in kept]
            # The order is the same on all file systems.
            for path in sorted(paths, key=lambda path: (len(path.parts), path)):
                found[path.name].append(path)
        return dict(found)


def compare(path: Path, file: WeightFile) -> FoundFile:
    """Compare the bytes of ``path`` with ``file``."""
    try:
        size = path.stat().st_size
        # Most wrong files have another size, and need not be read.
        if file.size and size != file.size:
            fault = f"{size} bytes, the manifest says {file.size}: cut off, or another file"
            return FoundFile(file, path, "", fault)
        digest = digest_of(path)
    except OSError as error:
        return FoundFile(file, path, "", f"cannot be read: {error.strerror}")
    fault = ""
    if file.sha256 and digest != file.sha256:
        fault = f"its digest is {digest}, the manifest says {file.sha256}: damaged, or another file"
    return FoundFile(file, path, digest, fault)
