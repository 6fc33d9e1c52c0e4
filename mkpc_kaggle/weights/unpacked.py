"""Checkpoints that arrive as directories: Kaggle unpacks uploaded archives, and torch's checkpoints are archives.

``NAME.pth`` becomes ``NAME/NAME/{data.pkl, data/, version, ...}``, with or without the suffix in the outer name.
"""

import hashlib
import zipfile
from collections.abc import Sequence
from pathlib import Path

from mkpc_kaggle.weights.digests import file_digests


def is_unpacked(folders: Sequence[str], files: Sequence[str]) -> bool:
    """Whether a directory with these entries has the contents of a torch checkpoint."""
    return "data" in folders and "data.pkl" in files


def names_of(directory: Path) -> frozenset[str]:
    """Possible names of the file that was unpacked into ``directory``, with or without its suffix."""
    return frozenset((directory.name, directory.parent.name))


def pack(directory: Path, file: Path) -> Path:
    """Write the checkpoint as one archive again, ``file``; raises ``OSError``."""
    # Mounted files may be dated 1970, which is before the format's first year.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, strict_timestamps=False) as archive:
        for path in _records(directory):
            archive.write(path, f"archive/{path.relative_to(directory).as_posix()}")
    return file


def digest_of(directory: Path) -> str:
    """``sha256:<hex>`` of all records and their names; it is not the digest of the file that was unpacked."""
    whole = hashlib.sha256()
    for path in _records(directory):
        record = file_digests(path).sha256.removeprefix("sha256:")
        whole.update(f"{record} {path.relative_to(directory).as_posix()}\n".encode())
    return f"sha256:{whole.hexdigest()}"


def _records(directory: Path) -> list[Path]:
    return sorted(path for path in directory.rglob("*") if path.is_file())
