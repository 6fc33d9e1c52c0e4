"""The weight files of this machine, found by name or digest and compared with the manifest.

The file of a slot (:meth:`WeightStore.file_of`) is the one that the user gives for it in Python, with any bytes.
Else it is the first usable one of three steps: files with the name of one of the slot's lines in the manifest;
renamed files with the digest of a line; checkpoints that are unpacked into a directory. Within a step, the
order of the lines decides first; then that of the directories, ``--weights``, ``$MKPC_WEIGHTS``, /kaggle/input;
then shallow paths are before deep ones.

Usable are files with the digest of their line. A file of a line without a digest (``unverified``) is usable unless
it is another line's, or has another size than its line. Unpacked checkpoints are usable (:func:`judge`).

Manifests in the searched directories add lines. If the file's licence is not permitted, or the file does not fit
its network, no other file is tried. The unit's fallback runs instead. Without one, the unit is skipped, but a
licence that is not permitted is an error, except in ``auto`` (:mod:`mkpc_kaggle.setup.availability`).
"""

import copy
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from mkpc_kaggle.data.outputs import weights_of_environment
from mkpc_kaggle.errors import UserError, plural, warn_once
from mkpc_kaggle.weights.checkpoint import is_unpacked_from, load_tensors, no_checkpoint
from mkpc_kaggle.weights.manifest import (
    MANIFEST,
    UNVERIFIED,
    WeightFile,
    digest_of,
    manifest,
    read_manifest,
)

if TYPE_CHECKING:
    import torch

KAGGLE_INPUT = Path("/kaggle/input")
MAX_POINTER_BYTES = 1 << 20  # web pages in the place of a file are smaller
UNKNOWN_LICENCE = "unknown (own weights)"
# A competition's input has thousands of images.
NOT_WEIGHTS = frozenset({".jpg", ".jpeg", ".png"})
CHECKPOINT_SUFFIXES = frozenset({".pth", ".pt", ".ckpt", ".safetensors", ".bin", ".pkl", ""})
# Weights of unknown size have about 50 MB; larger files are not read.
MAX_UNKNOWN_SIZE_BYTES = 1 << 28
UNPACKED = (
    "this checkpoint was unpacked into a directory, as Kaggle does; it is read from there, but cannot be held "
    "against the manifest's digest. Upload it as safetensors (mkpc weights convert)"
)


class FileState(StrEnum):
    """The result of comparing a file with the manifest."""

    GOOD = "good"  # bytes as in the manifest, under any name
    UNVERIFIED = "unverified"  # no digest in the manifest, or an unpacked checkpoint
    REFUSED = "refused"  # unreadable, or bytes that differ from the manifest


@dataclass(frozen=True)
class FoundFile:
    """A file that was compared with a line of the manifest.

    ``path`` is a directory if the checkpoint is unpacked. ``digest`` is ``sha256:<hex>`` of the
    bytes, or empty if the file is unreadable or its size is not in the manifest. ``note`` is the
    reason for the state.
    """

    file: WeightFile
    path: Path
    state: FileState
    digest: str
    note: str = ""

    @property
    def usable(self) -> bool:
        return self.state is not FileState.REFUSED


@dataclass(frozen=True)
class FileSearch:
    """The result of a search: the file, if found, and refused files of the right name."""

    found: FoundFile | None
    refused: tuple[FoundFile, ...] = ()


@dataclass(frozen=True)
class MissingWeights:
    """Slots of the manifest without a usable file, each with the names of files that would do."""

    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.files)

    def __or__(self, other: "MissingWeights") -> "MissingWeights":
        return MissingWeights({**self.files, **other.files})

    def __str__(self) -> str:
        """Return the files, such as ``aliked-n16: aliked-n16.pth; raco: raco.pth or raco.bin``."""
        return "; ".join(f"{slot}: {' or '.join(names)}" for slot, names in self.files.items())

    def command(self, recipe: str = "") -> str:
        """Return the command that gets them. The package's ``recipe`` is shorter than its slots."""
        return f"mkpc weights fetch {recipe or ' '.join(self.files)} --out DIR"


class WeightStore:
    """Weight files in the search directories.

    These are ``--weights``, then ``$MKPC_WEIGHTS``, then ``/kaggle/input/**``. Files are compared
    with the lines ``files``. By default, the lines are from the package's manifest and from
    manifests in the search directories, which list weights that ``package`` converted. The
    files ``chosen`` for slots are used as they are.
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
        self.directories = [*given, *weights_of_environment()]
        if KAGGLE_INPUT.is_dir():
            self.directories.append(KAGGLE_INPUT)
        self._given_files = files
        self._device = "cpu"
        self._chosen: dict[str, FoundFile] = {}  # by slot; they replace the results of searches
        self._searches: dict[tuple[WeightFile, ...], FileSearch] = {}
        for slot, path in chosen.items():
            self._chosen[slot] = self._given(slot, path)

    @property
    def searched(self) -> str:
        """The search directories as text for messages."""
        return ", ".join(map(str, self.directories)) or "nowhere: name a directory with --weights"

    @cached_property
    def files(self) -> tuple[WeightFile, ...]:
        """The lines to compare with, one per name; the package's manifest comes first.

        If the package's manifest has no digest for a file, a manifest in the search directories
        supplies it: the digest of the first download.
        """
        if self._given_files is not None:
            return tuple(self._given_files)
        lines = {file.name: file for file in manifest()}
        for path in self._by_name.get(MANIFEST, ()):
            try:
                here = read_manifest(path)
            except UserError as error:
                warn_once(f"passed over: {error}")
                continue
            for file in here:
                known = lines.setdefault(file.name, file)
                # A digest of the package's manifest is never replaced.
                if known.digest == UNVERIFIED:
                    lines[file.name] = replace(known, size=file.size, digest=file.digest)
        return tuple(lines.values())

    def _given(self, slot: str, path: Path) -> FoundFile:
        """Return the file that the user gives for a slot, with any bytes.

        Raises :class:`UserError` for an unknown slot and an unreadable file.
        """
        if not self.alternatives(slot):
            known = ", ".join(dict.fromkeys(file.slot for file in self.files))
            raise UserError(f"weights: unknown slot {slot!r}; known: {known}")
        try:
            digest = digest_of(path)
            size = path.stat().st_size
        except OSError as error:
            raise UserError(f"weights[{slot!r}]: {path}: {error.strerror}") from error
        # A file of the manifest keeps its licence; of other files it is unknown.
        same = (file for file in self.alternatives(slot) if file.digest == digest)
        own = WeightFile(path.name, size, digest, UNKNOWN_LICENCE, slot, str(path))
        return FoundFile(next(same, own), path, FileState.GOOD, digest, "given for its slot")

    def alternatives(self, slot: str) -> list[WeightFile]:
        """Return the manifest's lines for a slot, in order of preference."""
        return [file for file in self.files if file.slot == slot]

    def file_of(self, slot: str) -> FoundFile | None:
        """Return the slot's file or ``None``. Warn of refused files of the right name."""
        if slot in self._chosen:
            return self._chosen[slot]
        search = self.search(self.alternatives(slot))
        for refused in search.refused:
            warn_once(f"passed over: {refused.path}: {refused.note}")
        return search.found

    def load(self, slot: str) -> "dict[str, torch.Tensor]":
        """Return the slot's tensors by name. Raise :class:`UserError` for a missing or bad file."""
        found = self.file_of(slot)
        if found is None:
            missing = self.missing([slot])
            raise UserError(
                f"no weights for {missing} not found (searched {self.searched}); "
                f"`{missing.command()}` gets them"
            )
        return load_tensors(found.path, self._device)

    def missing(self, slots: Iterable[str]) -> MissingWeights:
        """Return the slots without a usable file."""
        files = {
            slot: tuple(file.name for file in self.alternatives(slot))
            for slot in slots
            if self.file_of(slot) is None
        }
        return MissingWeights(files)

    def on_meta(self, *chosen: FoundFile) -> "WeightStore":
        """Return a store that loads names, shapes and types only, on the device "meta".

        ``chosen`` are used for their slots instead of the files that a search would find.
        """
        # A shallow copy shares the results of searches.
        other = copy.copy(self)
        other._device = "meta"
        other._chosen = self._chosen | {found.file.slot: found for found in chosen}
        return other

    def search(self, lines: Sequence[WeightFile]) -> FileSearch:
        """Return the first usable file for these lines.

        Results are cached and sent to workers with the store.
        """
        key = tuple(lines)
        if key not in self._searches:
            # By path; comparison by digest replaces comparison by name.
            judged: dict[Path, FoundFile] = {}
            for file in self._candidates(lines):
                judged[file.path] = file
                if file.usable:
                    break
            found = next((file for file in judged.values() if file.usable), None)
            refused = tuple(file for file in judged.values() if not file.usable)
            self._searches[key] = FileSearch(found, refused)
        return self._searches[key]

    def verify(self) -> list[FoundFile]:
        """Return all files whose name or digest is in the manifest, sorted by path."""
        found: dict[Path, FoundFile] = {}
        for file in self._candidates(self.files):
            found.setdefault(file.path, file)  # the first per path
        return [found[path] for path in sorted(found)]

    def _candidates(self, lines: Sequence[WeightFile]) -> Iterator[FoundFile]:
        """Yield files for these lines: by name, then by digest, then unpacked checkpoints."""
        for file in lines:
            for path in self._by_name.get(file.name, ()):
                yield judge(path, file, self.files)
        # Renamed files. Only files of the right size are read.
        sizes, unpacked = self._walked
        for file in lines:
            if file.digest == UNVERIFIED:
                continue
            if file.size < 0:
                alike = self._small_by_digest.get(file.digest, [])
            else:
                alike = [path for path, size in sizes.items() if size == file.size]
            for path in alike:
                found = judge(path, file)
                if found.state is FileState.GOOD:
                    yield found
        for file in lines:
            for directory in unpacked:
                if is_unpacked_from(directory, file):
                    yield judge(directory, file)

    # Indexes of the files: a directory may have a hundred thousand, the manifest has dozens of
    # lines.

    @cached_property
    def _by_name(self) -> dict[str, list[Path]]:
        found = defaultdict(list)
        for path in self._walked[0]:
            found[path.name].append(path)
        return found

    @cached_property
    def _small_by_digest(self) -> dict[str, list[Path]]:
        """Files, by digest, that could be weights of unknown size."""
        found = defaultdict(list)
        for path, size in self._walked[0].items():
            if 0 <= size <= MAX_UNKNOWN_SIZE_BYTES and path.suffix.lower() in CHECKPOINT_SUFFIXES:
                with suppress(OSError):  # unreadable
                    found[digest_of(path)].append(path)
        return found

    @cached_property
    def _walked(self) -> tuple[dict[Path, int], list[Path]]:
        """The size in bytes of each file, shallow files first, and unpacked checkpoints.

        Images are left out; a file that is not regular has size -1. Links are followed, since
        Kaggle mounts inputs by links. No directory is visited twice, so cycles end.
        """
        sizes: dict[Path, int] = {}
        unpacked: list[Path] = []
        entered: set[str] = set()
        for root in self.directories:
            files: list[Path] = []
            checkpoints: list[Path] = []
            for folder, folders, names in os.walk(root, followlinks=True):
                real = os.path.realpath(folder)
                is_checkpoint = "data" in folders and "data.pkl" in names
                if real in entered or is_checkpoint:
                    folders.clear()  # os.walk skips the subfolders
                if is_checkpoint and real not in entered:
                    checkpoints.append(Path(folder))  # an archive that Kaggle unpacked
                elif real not in entered:
                    files += [Path(folder, name) for name in names]
                entered.add(real)
            # The order is the same on all file systems.
            unpacked += sorted(checkpoints, key=_depth)
            for path in sorted(files, key=_depth):
                if path.suffix.lower() not in NOT_WEIGHTS:
                    sizes[path] = path.stat().st_size if os.path.isfile(path) else -1  # noqa: PTH113  never raises
        return sizes, unpacked


def _depth(path: Path) -> tuple[int, Path]:
    """Shallow paths win over deep ones of the same name."""
    return len(path.parts), path


def judge(path: Path, file: WeightFile, files: Iterable[WeightFile] = ()) -> FoundFile:
    """Compare the file, or unpacked checkpoint, at ``path`` with ``file``.

    ``files`` is the whole manifest, to name another file that has these bytes.
    """
    try:
        unpacked = (path / "data.pkl").is_file()
        if path.is_dir() and not unpacked:
            return FoundFile(file, path, FileState.REFUSED, "", "it is a directory")
        size = path.stat().st_size
        if path.is_file() and size <= MAX_POINTER_BYTES and (what := no_checkpoint(path)):
            return FoundFile(file, path, FileState.REFUSED, "", what)
        # Most wrong files have another size, and need not be read.
        length = plural(size, "byte")
        wrong_size = f"{length}, the manifest says {file.size}: truncated, or another file"
        if path.is_file() and not _may_be(size, file, files):
            return FoundFile(file, path, FileState.REFUSED, "", wrong_size)
        digest = digest_of(path)
    except OSError as error:
        return FoundFile(file, path, FileState.REFUSED, "", f"cannot be read: {error.strerror}")
    other = next((line.name for line in files if line.digest == digest), "")
    state = FileState.REFUSED
    if digest == file.digest:
        state = FileState.GOOD
        note = "" if path.name == file.name else f"it is {file.name}"
    elif unpacked:
        state = FileState.UNVERIFIED
        note = UNPACKED
    elif other:
        note = f"it has the bytes of {other}"
    elif 0 <= file.size != size:
        note = wrong_size
    elif file.digest == UNVERIFIED:
        state = FileState.UNVERIFIED
        note = f"the manifest has no digest for it; this file's is {digest}"
    else:
        note = f"its digest is {digest}, the manifest says {file.digest}: damaged, or another file"
    return FoundFile(file, path, state, digest, note)


def _may_be(size: int, file: WeightFile, files: Iterable[WeightFile]) -> bool:
    """Return whether a file of ``size`` bytes may be one of the manifest's files."""
    if file.size < 0 or size == file.size:
        return True
    sizes = [line.size for line in files]
    has_unknown = any(known < 0 for known in sizes)
    return size in sizes or (has_unknown and size <= MAX_UNKNOWN_SIZE_BYTES)
