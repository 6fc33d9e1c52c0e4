"""A file on this machine compared with its line of the manifest."""

import stat
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.digests import Digests, file_digests
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile
from mkpc_kaggle.weights.notices import warn_once
from mkpc_kaggle.weights.unpacked import digest_of


class State(StrEnum):
    """What the comparison with the manifest says of a file."""

    GOOD = "good"
    RENAMED = "renamed"
    """another name, but the bytes of a file of the manifest: as good"""
    UNVERIFIED = "unverified"
    """the manifest has no digest for it"""
    UNPACKED = "unpacked"
    """a checkpoint that was unpacked into a directory: readable, but the file's digest is lost"""
    TRUNCATED = "truncated"
    SWAPPED = "another file"
    """the right name, other bytes"""
    UNREADABLE = "unreadable"

    @property
    def usable(self) -> bool:
        return self in (State.GOOD, State.RENAMED, State.UNVERIFIED, State.UNPACKED)


@dataclass(frozen=True)
class FoundFile:
    """``digest`` is ``sha256:<hex>`` of the bytes, empty for an unreadable file; ``note`` explains the state.

    ``path`` is a directory where the state is ``UNPACKED``.
    """

    file: WeightFile
    path: Path
    state: State
    digest: str
    note: str = ""

    @property
    def verified(self) -> bool:
        """The bytes are those of the manifest."""
        return self.state in (State.GOOD, State.RENAMED)

    @property
    def is_here(self) -> bool:
        """Whether its path leads to the same bytes on this machine, wherever it was found."""
        try:
            unpacked = self.state is State.UNPACKED
            return (digest_of(self.path) if unpacked else file_digests(self.path).sha256) == self.digest
        except OSError:
            return False

    def link_or_copy(self, directory: Path, fetch: Callable[[Path], bytes]) -> None:
        """Put it into a directory under its name: a link if it is here, else the bytes that ``fetch`` brings."""
        target = directory / self.file.name
        if self.is_here:
            target.symlink_to(self.path)
        elif self.state is State.UNPACKED:
            raise UserError(f"{self.path} cannot be sent to other machines: {self.note}")
        else:
            target.write_bytes(fetch(self.path))


def examine(path: Path, file: WeightFile, files: Iterable[WeightFile]) -> FoundFile:
    """The state of the file at ``path``, named as ``file``; ``files`` are all lines of the manifest."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return FoundFile(file, path, State.UNREADABLE, "", "no regular file")
        digests = file_digests(path)
    except OSError as error:
        return FoundFile(file, path, State.UNREADABLE, "", f"cannot be read: {error.strerror}")
    state, note = _judge(digests, file, files)
    return FoundFile(file, path, state, digests.sha256, note)


def examine_unpacked(directory: Path, file: WeightFile) -> FoundFile:
    """A directory into which ``file``, by its name, was unpacked."""
    try:
        digest = digest_of(directory)
    except OSError as error:
        return FoundFile(file, directory, State.UNREADABLE, "", f"cannot be read: {error.strerror}")
    note = (
        "this checkpoint was unpacked into a directory, as Kaggle does; it is read from there, but cannot be held "
        "against the manifest's digest. Upload it as safetensors (python -m mkpc_kaggle weights convert)"
    )
    return FoundFile(file, directory, State.UNPACKED, digest, note)


def recognise(path: Path, file: WeightFile) -> FoundFile | None:
    """The file at ``path``, whatever its name, if it has the digest of ``file``."""
    try:
        digests = file_digests(path)
    except OSError as error:
        warn_once(f"{path} cannot be read, so it is not known what it is: {error.strerror}")
        return None
    if not digests.have(file.digest):
        return None
    state = State.GOOD if path.name == file.name else State.RENAMED
    return FoundFile(file, path, state, digests.sha256, "" if state is State.GOOD else f"it is {file.name}")


def _judge(digests: Digests, file: WeightFile, files: Iterable[WeightFile]) -> tuple[State, str]:
    if digests.have(file.digest):
        return State.GOOD, ""
    for other in files:
        if digests.have(other.digest):
            return State.SWAPPED, f"its bytes are those of {other.name}"
    if 0 <= file.size != digests.size:
        state = State.TRUNCATED if digests.size < file.size else State.SWAPPED
        return state, f"{digests.size} bytes, the manifest says {file.size}: truncated, or another file"
    if file.digest == UNVERIFIED:
        return State.UNVERIFIED, f"the manifest has no digest for it; this file's is {digests.sha256}"
    own = digests.sha256 if file.digest.startswith("sha256:") else digests.git_blob
    return State.SWAPPED, f"its digest is {own}, the manifest says {file.digest}: damaged, or another file"
